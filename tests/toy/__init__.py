"""A small furnished room with its own ray caster: quick logs for tests, without the simulator's packages."""
