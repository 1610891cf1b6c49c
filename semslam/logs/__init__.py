"""The MCAP log: read it (and save what can be saved), decode it, write it."""
