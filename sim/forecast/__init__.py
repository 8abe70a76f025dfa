"""What a valid scenario will not do well, said before it is run."""
