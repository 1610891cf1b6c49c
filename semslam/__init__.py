"""semslam: pose tracks and semantic maps from MCAP robot logs, offline and in batch."""

__version__ = "0.1.0"
