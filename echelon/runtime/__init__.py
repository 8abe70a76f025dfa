"""Transport of messages between roles: links, mailboxes, messages as bytes, Zenoh sessions, runners, and the order of turns."""
