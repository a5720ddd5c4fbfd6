"""Floor 1: the robots. Algorithms as coroutines over a Body, and the process that drives one."""
