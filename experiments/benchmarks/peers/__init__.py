"""Programs of other implementations, and TD7 in PyTorch, for `python -m experiments.bench --compare`.

Each program runs in an interpreter that has its packages, and imports nothing of this project. It prints "ready" when
it has compiled, reads a number of steps per line, and prints "done" when it has made them.
"""
