"""Techniques: ways of drawing directions for a picture, by name."""

from dsfit.render.techniques.registry import TECHNIQUES, technique
from dsfit.render.techniques.technique import Technique

__all__ = ["TECHNIQUES", "Technique", "technique"]
