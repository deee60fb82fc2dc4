"""Training of amortised proposals: one fit for every shading context of a fibre."""

from dsfit.fit.amortise.descent import Progress
from dsfit.fit.amortise.train import TRAINING, Amortised, amortise
from dsfit.fit.amortise.unseen import HeldOut, held_out, held_out_contexts

__all__ = ["TRAINING", "Amortised", "HeldOut", "Progress", "amortise", "held_out", "held_out_contexts"]
