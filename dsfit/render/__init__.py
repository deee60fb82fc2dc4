"""Rendering of hair: geometry, visibility, scatter counts, integrator, images."""

from __future__ import annotations

from dsfit.render.hits import HitContext, Hits
from dsfit.render.strands import Strands

__all__ = ["HitContext", "Hits", "Strands"]
