"""Grids of runs: the cells of the paper's tables, and training them one after another."""
