"""What carries messages between roles: links, mailboxes, the wire, Zenoh sessions, and who has which turn."""
