"""What a careless or malicious caller hands to the core, in tables by theme."""
