"""Training of semslam's own networks (`pip install 'semslam[train]'`); reached only from the command that trains."""
