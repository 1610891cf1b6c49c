"""One thread for every numeric library, as the command line has it; set before numpy is loaded."""

from __future__ import annotations

import os
import signal

from semslam.pipeline.threads import ONE_THREAD

os.environ.update(ONE_THREAD, ORT_DISABLE_TELEMETRY="1")
# Started in the background, a shell has us ignore Ctrl-C, and so would every process that a test starts and interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
