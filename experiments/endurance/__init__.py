"""Endurance tests: runs that are killed and resumed, and many steps of MuJoCo C."""
