"""One thread for every numeric library, as the command line has it; set before numpy is loaded."""

from __future__ import annotations

import os

from semslam.pipeline.threads import ONE_THREAD

os.environ.update(ONE_THREAD, ORT_DISABLE_TELEMETRY="1")
