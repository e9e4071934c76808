"""Grids of runs: the cells of the paper's tables and of grids of one's own, and training them through a launcher."""
