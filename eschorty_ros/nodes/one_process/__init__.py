"""All nodes in one process, and the parameters of all of them."""
