"""Networks of the architectures that adapters read, with random weights, each with its own project's reading."""
