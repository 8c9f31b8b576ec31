"""All nodes in one process, for the command line."""
