"""One thread per process: tests run in parallel processes, and their tensors are too small for more to help."""

from __future__ import annotations

import torch

torch.set_num_threads(1)
