"""Reads a drawn figure."""

import numpy as np
from matplotlib.colors import to_rgb


def pixels_of(image, colour):
    return int((np.abs(image[..., :3] - to_rgb(colour)).max(axis=-1) < 0.02).sum())


def panels(figure):
    return [axes for axes in figure.axes if axes.get_visible()]


def legend_of(figure):
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
    return [text.get_text() for legend in legends for text in legend.get_texts()]
