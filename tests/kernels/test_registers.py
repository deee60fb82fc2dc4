"""Compiled code leaves the vector registers as it found them: upper halves in use slow down what others run later."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dsfit.kernels.compiler import built
from tests.kernels import cases

SOURCE = """
#include <cstdint>
extern "C" {
int32_t in_use() {
    uint32_t low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(1));
    return low & 4;  // upper halves of ymm
}
void leave_in_use() { __asm__ volatile("vpcmpeqd %ymm0, %ymm0, %ymm0"); }
void clear() { __asm__ volatile("vzeroupper"); }
}
"""


def tells() -> bool:
    """Whether this processor tells which registers are in use."""
    path = Path("/proc/cpuinfo")
    flags = path.read_text().split() if path.exists() else []
    return "xgetbv1" in flags and "avx2" in flags and cases.has_compiler()


@pytest.mark.skipif(not tells(), reason="no compiler, or a processor that does not tell which registers are in use")
def test_no_function_leaves_upper_halves_in_use() -> None:
    code = built(SOURCE)
    code.leave_in_use()
    if not code.in_use():
        pytest.skip("a processor that does not tell which registers are in use")
    kernel, context = cases.kernel(mode="compiled"), cases.contexts(40)
    theta_i, phi = cases.directions(8, 40)
    contexts = kernel.prepare_context(context)
    u = cases.uniforms(8, 40)
    plain = context.theta_r.contiguous(), context.n.contiguous(), context.v.contiguous()
    shape = kernel.snapshot.shape(context)
    given = (shape.log_weights, shape.mode, shape.below, shape.above)
    program = kernel.program("both")
    out = torch.empty_like(contexts.fields)
    calls = {
        "prepare": lambda: program.run.prepare(program.start, *plain),
        "fields": lambda: program.run.fields(plain[0], given, program.components, out),
        "eval": lambda: kernel.eval(contexts, theta_i, phi),
        "log_prob": lambda: kernel.log_prob(contexts, theta_i, phi),
        "sample": lambda: kernel.sample(contexts, u),
        "sample_eval": lambda: kernel.sample_eval(contexts, u),
        "shade": lambda: kernel.shade(*plain, u),
    }
    for name, call in calls.items():
        code.clear()
        call()
        assert not code.in_use(), name
