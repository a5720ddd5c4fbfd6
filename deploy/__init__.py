"""Floor 2: puts the parts together, runs them, judges the run and shows it."""
