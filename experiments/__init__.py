"""The commands (`python -m experiments.COMMAND`) and the packages behind them; the guide is README.md."""
