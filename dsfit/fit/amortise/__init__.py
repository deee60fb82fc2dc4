"""Training of amortised proposals: one fit for every shading context of a fibre."""

from dsfit.fit.amortise.train import TRAINING, Amortised, Progress, amortise

__all__ = ["TRAINING", "Amortised", "Progress", "amortise"]
