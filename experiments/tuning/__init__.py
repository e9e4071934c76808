"""Tuning swept settings: Optuna proposes, one run trains a batch of trials, the winner is trained again.

space.py          the settings that are tuned, and their ranges
proposals.py      the next trial, as a function of the trials before it
study.py          the trials in a journal file: asked, told, read again after a kill
batches.py        the run of a batch of trials, and the trials' values from its files
rounds.py         where batches are trained: the launcher that all rounds share
first_refusal.py  nothing is left of a new study whose first batch is refused
tuner.py          the loop: ask, train, tell
fresh_seeds.py    the winner and its baseline on seeds that tuning never saw
"""
