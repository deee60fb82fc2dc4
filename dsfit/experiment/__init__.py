"""Experiments: configs, runs, results on disk. What Python code needs of them is saving and loading proposals."""

from dsfit.experiment.store import load_proposal, save_proposal

__all__ = ["load_proposal", "save_proposal"]
