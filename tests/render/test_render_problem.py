"""Uniform numbers of a rendering belong to pixels: nets over a pixel's hits, independent of each other, and the same
whatever is drawn with them."""

from __future__ import annotations

import pytest
import torch
from scipy import stats

import dsfit.render.problem
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.render.problem import RenderProblem
from dsfit.scene import ConstantLight
from dsfit.streams import ContextStream
from tests.render import support_render as support


def ready(uniforms="sobol", subsamples=4, all_rays=True, dtype=torch.float32, width=6):
    scene = support.scene(ConstantLight(1.0), subsamples=subsamples, all_rays=all_rays, dtype=dtype, width=width)
    hits = scene.hits(range(4), range(width))
    problem = RenderProblem(scene.integrand(hits, exact=True), ContextStream(), dtype=dtype, uniforms=uniforms)
    return problem, scene.contexts(hits), hits


def drawn(problem, samples, contexts, dimension=3, seed=5):
    pieces = problem.draw(samples, contexts, dimension, torch.Generator().manual_seed(seed))
    return torch.cat(list(pieces))


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
def test_numbers_do_not_depend_on_what_is_drawn_with_them(uniforms, monkeypatch):
    problem, contexts, hits = ready(uniforms, all_rays=False)
    whole = drawn(problem, 6, contexts)
    assert whole.shape == (6, len(hits), 3) and 0 < float(whole.min()) and float(whole.max()) < 1
    some = torch.tensor([20, 3, 4])
    torch.testing.assert_close(drawn(problem, 6, contexts[some]), whole[:, some], rtol=0, atol=0)
    monkeypatch.setattr(dsfit.render.problem, "CHUNK", 2 * len(hits))
    torch.testing.assert_close(drawn(problem, 6, contexts), whole, rtol=0, atol=0)
    monkeypatch.undo()
    last = hits.pixel >= 12  # another tile: its hits alone, pixels under their names in the picture
    problem.bind(hits[last], problem.integrand.scattering, hits.pixel[last])
    other = contexts[last]
    object.__setattr__(other, "hit", torch.arange(int(last.sum())))
    torch.testing.assert_close(drawn(problem, 6, other), whole[:, last], rtol=0, atol=0)
    assert not torch.equal(drawn(problem, 6, other, seed=6), whole[:, last])
    with pytest.raises(InputError, match="HitContext"):
        next(problem.draw(1, Context(0.1), 2, torch.Generator()))


@pytest.mark.parametrize(("samples", "kept"), [(4, 4), (16, 16)])
def test_sobol_points_are_a_net_over_the_whole_pixel(samples, kept):
    problem, contexts, hits = ready(subsamples=4)
    u = drawn(problem, samples, contexts, 2)
    of_pixel = u.reshape(samples, 24, 4, 2).permute(1, 2, 0, 3)  # [pixel, hit, sample, 2]
    whole = of_pixel.flatten(1, 2)
    side = round(whole.shape[1] ** 0.5)
    for rows in (1, side, side * side):  # elementary intervals of three shapes: one point in each
        columns = side * side // rows
        cell = (whole[..., 0] * rows).long() * columns + (whole[..., 1] * columns).long()
        assert bool((cell.sort(1).values == torch.arange(side * side)).all())
    own = (of_pixel[..., 0] * samples).long().sort(2).values  # every hit's block is a net too
    assert bool((own == torch.arange(samples)).all())


def test_hits_of_a_pixel_share_a_sequence_and_pixels_do_not():
    problem, contexts, hits = ready(subsamples=1, width=600)
    u = drawn(problem, 2, contexts, 2).double()
    centred = (u - 0.5) * 12**0.5
    count = len(hits) // 2
    for a, b in ((0, 0), (0, 1), (1, 1)):
        between = (centred[0, :-1:2, a] * centred[0, 1::2, b]).sum() / count**0.5
        assert abs(float(between)) < 4
    assert stats.kstest(u[0, :, 0].numpy(), "uniform").pvalue > 1e-3
    assert float((centred[0, :, 0] * centred[1, :, 0]).mean()) < -0.5  # within a pixel: one in each half


def test_independent_numbers_look_independent():
    problem, contexts, hits = ready("random", subsamples=2, width=300)
    u = drawn(problem, 4, contexts, 3).double()
    assert stats.kstest(u.flatten().numpy(), "uniform").pvalue > 1e-3
    centred = ((u - 0.5) * 12**0.5).permute(1, 0, 2).reshape(len(hits), -1)
    correlation = centred.T @ centred / len(hits) ** 0.5
    off = correlation - torch.diag(correlation.diagonal())
    assert float(off.abs().max()) < 4.5
    neighbours = (centred[:-1] * centred[1:]).sum(0) / len(hits) ** 0.5
    assert float(neighbours.abs().max()) < 4.5


def test_sobol_points_are_unbiased_and_their_error_falls_faster():
    errors = {}
    for uniforms in ("random", "sobol"):
        problem, contexts, _ = ready(uniforms, subsamples=4, dtype=torch.float64)
        for samples in (4, 16):
            runs = []
            for seed in range(40):
                u = drawn(problem, samples, contexts, 2, seed)
                value = torch.exp(u[..., 0]) * (1 + u[..., 1].square())
                runs.append(value.mean(0).reshape(24, 4).mean(1))
            found = torch.stack(runs)
            truth = (torch.e - 1) * 4 / 3
            error = found - truth
            assert abs(float(error.mean() / error.std()) * len(error.flatten()) ** 0.5) < 4
            errors[uniforms, samples] = float(error.square().mean().sqrt())
    assert 1.7 < errors["random", 4] / errors["random", 16] < 2.3
    assert errors["sobol", 4] / errors["sobol", 16] > 3.2
    assert errors["sobol", 4] < 0.4 * errors["random", 4]


def test_samples_and_hits_that_are_no_powers_of_two():
    problem, contexts, hits = ready(subsamples=3, all_rays=False)
    u = drawn(problem, 3, contexts, 2)
    assert u.shape == (3, len(hits), 2)
    assert len(torch.unique(u.reshape(-1, 2), dim=0)) == 3 * len(hits)  # no point twice
    for samples in (1, 5, 7):
        assert len(drawn(problem, samples, contexts, 1)) == samples
