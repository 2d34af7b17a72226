"""Examples e01 to e09, each on a page, and longer ones: the only place where maps, planner and robots meet."""
