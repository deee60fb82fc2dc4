"""Rendering of hair: geometry, visibility, scatter counts, integrator, images."""

from __future__ import annotations

from dsfit.render.camera import Camera
from dsfit.render.hits import HitContext, Hits, context_of, coverage_of
from dsfit.render.strands import Strands
from dsfit.render.visibility import Visibility

__all__ = ["Camera", "HitContext", "Hits", "Strands", "Visibility", "context_of", "coverage_of"]
