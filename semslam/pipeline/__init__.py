"""Who runs what, and what the user sees.

The way of a run: `discover` finds logs, `config` reads the configuration, `plan` turns both into tasks and decides
which of them the `cache` already answers, `runner` gives the others to an `executors` executor, whose workers call
`worker.execute` with a `context`, and `console` shows it. `folder` says what lies where in an output folder.

Modules here that planning needs import neither numpy nor pyarrow, so that a run with nothing to do ends at once.
"""
