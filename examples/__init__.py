"""Closed-loop examples: the only place where maps, planner and robots meet."""
