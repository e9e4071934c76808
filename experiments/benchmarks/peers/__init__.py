"""Other people's projects, and TD7 in PyTorch, measured beside this one (`python -m experiments.bench --compare`).

Each is a program of its own, run by an interpreter that has what it needs. It prints "ready" when it has compiled,
reads numbers of steps line by line, and prints "done" when it has made them. It imports nothing of this project.
"""
