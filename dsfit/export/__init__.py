"""A fitted sampler and its BSDF as one C++ header, for renderers that know nothing of torch."""

from __future__ import annotations

from dsfit.export.writer import Header, header, write_example, write_header

__all__ = ["Header", "header", "write_example", "write_header"]
