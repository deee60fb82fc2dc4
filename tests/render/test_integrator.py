"""Tiles of a picture: their values against quadrature, their variance against what is seen over seeds, and the same
picture from the same seed."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import dsfit.render.integrator as integrator
from dsfit.errors import InputError
from dsfit.race.density import DensitySampler
from dsfit.race.peers.uniform import Uniform
from dsfit.render.integrator import groups, render_tile
from dsfit.render.techniques import Technique, technique
from tests.render import support_render as support

PIXEL, lit, pixel_truth = support.PIXEL, support.lit, support.pixel_truth


def rendered(scene, kind="uniform", light=0.0, samples=64, passes=4, seed=1, where=PIXEL):
    made = technique(kind, light=light)
    return render_tile(scene, made, *where, samples=samples, passes=passes, seed=seed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("kind", "name", "light"),
    [("furnace", "uniform", 0.0), ("furnace", "amortised", 0.0), ("sun", "light", 0.0), ("lobe", "amortised", 0.5)],
)
def test_a_pixel_agrees_with_quadrature(kind, name, light, dtype):
    scene, truth = support.scene(lit(kind), all_rays=True, dtype=dtype), pixel_truth(kind)
    found = rendered(scene, name, light=light, samples=2048, passes=16)
    error = found.variance[0, 0].sqrt()
    assert float((error / truth).max()) < 0.02
    # the kernel's tables add about 1e-4 of the value
    assert bool(((found.radiance[0, 0] - truth).abs() < 4 * error + 5e-4 * truth).all())


class WithoutJacobian(Uniform):
    """Uniform in theta_i, as if that were uniform over the sphere."""

    name = "without Jacobian"

    def at(self, contexts):
        class Wrong(type(self.proposal(contexts))):
            def sample_with_log_prob(self, u):
                omega, log_p = super().sample_with_log_prob(u)
                theta = (u[..., 0] - 0.5) * torch.pi
                return torch.stack([theta, omega[..., 1]], dim=-1), log_p

        return DensitySampler(self.problem, Wrong(contexts), contexts)


def test_a_dropped_jacobian_is_rejected():
    scene, truth = support.scene(lit("furnace"), all_rays=True), pixel_truth("furnace")
    wrong = Technique("wrong", WithoutJacobian())
    found = render_tile(scene, wrong, *PIXEL, samples=2048, passes=16, seed=1)
    error = found.variance[0, 0].sqrt()
    assert bool(((found.radiance[0, 0] - truth).abs() > 8 * error + 5e-4 * truth).any())


def test_layers_of_a_tile():
    scene = support.scene(lit("furnace"), background=[0.5, 0.25, 0.0], subsamples=5, v=0.4, n=2.0)
    rows, columns = range(1, 4), range(0, 3)
    found = rendered(scene, samples=4, passes=3, where=(rows, columns))
    hits = scene.hits(rows, columns)
    count = torch.bincount(hits.pixel, minlength=9).reshape(3, 3)
    assert bool((count[:, 0] == 0).all()) and 0 < int(count[:, 1:].min()) < 5
    torch.testing.assert_close(found.coverage, count / 5, check_dtype=False)
    assert torch.equal(found.samples, count * 12)
    background = torch.tensor([0.5, 0.25, 0.0], dtype=torch.float64)
    torch.testing.assert_close(found.radiance[:, 0], background.expand(3, 3))
    assert bool((found.variance[:, 0] == 0).all()) and bool((found.variance[:, 1:] > 0).all())
    torch.testing.assert_close(found.n[:, 1:], torch.full((3, 2), 2.0, dtype=torch.float64))
    torch.testing.assert_close(found.depth, torch.where(count > 0, 10.0, 0.0).double())
    dark = support.scene(lit("furnace"), subsamples=5, v=0.4, n=2.0)
    black = rendered(dark, samples=4, passes=3, where=(rows, columns))
    seen = (1 - count / 5).unsqueeze(-1) * background
    torch.testing.assert_close(found.radiance, black.radiance + seen)
    assert found.seconds > 0


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
def test_equal_seeds_make_equal_pictures_whatever_the_tiles(uniforms, monkeypatch):
    scene = support.scene(lit("lobe"), subsamples=4)
    made = technique("chapter", {"proposals": ["M_R", "TT", "uniform"]}, light=0.25, uniforms=uniforms)
    options = {"samples": 8, "passes": 3}
    whole = render_tile(scene, made, range(4), range(6), seed=7, **options)
    again = render_tile(scene, made, range(4), range(6), seed=7, **options)
    assert torch.equal(whole.radiance, again.radiance) and torch.equal(whole.variance, again.variance)
    other = render_tile(scene, made, range(4), range(6), seed=8, **options)
    assert not torch.equal(whole.radiance, other.radiance)
    monkeypatch.setattr(integrator, "GROUP", 7)
    for rows, columns in ((range(1, 3), range(2, 6)), (range(4), range(3, 4))):
        part = render_tile(scene, made, rows, columns, seed=7, **options)
        expected = whole.radiance[rows.start : rows.stop, columns.start : columns.stop]
        torch.testing.assert_close(part.radiance, expected, rtol=2e-5, atol=1e-7)


def test_the_variance_is_that_over_seeds():
    scene = support.scene(lit("lobe"), all_rays=True, subsamples=1, width=3, height=2)
    made, where = technique("uniform"), (range(2), range(3))
    runs = [render_tile(scene, made, *where, samples=4, passes=4, seed=k) for k in range(400)]
    value, variance = (torch.stack([getattr(run, name) for run in runs]) for name in ("radiance", "variance"))
    ratio = variance.mean(0) / value.var(0)
    assert 0.85 < float(ratio.mean()) < 1.15 and 0.6 < float(ratio.min()) and float(ratio.max()) < 1.6
    doubled = render_tile(scene, made, *where, samples=4, passes=1600, seed=3).variance * 400
    assert 0.8 < float((doubled / value.var(0)).mean()) < 1.2


def test_groups_do_not_cut_pixels():
    pixel = torch.tensor([0, 0, 0, 2, 3, 3, 7, 7, 7, 7])
    found = groups(pixel, 4)
    assert [pixel[part].tolist() for part in found] == [[0, 0, 0, 2], [3, 3], [7, 7, 7, 7]]
    assert groups(pixel[:0]) == [] and len(groups(pixel, 1)) == 4 and len(groups(pixel)) == 1


def test_memory_is_bounded_by_groups_whatever_the_tile():
    largest = {}
    for height in (8, 64):
        scene = support.scene(lit("furnace"), all_rays=True, subsamples=8, width=32, height=height)
        made = technique("uniform").prepare(scene)
        seen, held = [], []
        plain = made.problem.integrand._shaded

        def spied(omega, context, plain=plain, seen=seen, held=held):
            seen.append(omega[..., 0].numel())
            held.append(len(context.hit))
            return plain(omega, context)

        made.problem.integrand._shaded = spied
        found = render_tile(scene, made, range(height), range(32), samples=16, passes=2, seed=1)
        assert sum(seen) == int(found.samples.sum()) == height * 32 * 8 * 16 * 2
        largest[height] = max(seen), max(held)
    assert largest[8] == (integrator.CHUNK, 2048) and largest[64] == (integrator.CHUNK, integrator.GROUP)


class Broken(Uniform):
    """Estimates that are not finite in one pixel."""

    name = "broken"

    def at(self, contexts):
        sampler = super().at(contexts)
        plain = sampler.estimate

        def estimate(samples, generator):
            found = plain(samples, generator)
            found[5, 1] = torch.nan
            return found

        sampler.estimate = estimate
        return sampler


def test_what_is_not_finite_is_an_error_with_its_pixel():
    scene = support.scene(lit("furnace"), all_rays=True, subsamples=2)
    with pytest.raises(InputError, match=r"technique 'mine', pixel row 1, column 4.*nan"):
        render_tile(scene, Technique("mine", Broken()), range(1, 4), range(2, 6), samples=2, passes=2, seed=1)


def test_bad_arguments():
    scene, made = support.scene(lit("furnace")), technique("uniform")
    tile = {"samples": 2, "passes": 2, "seed": 1}
    for name, value in (("samples", 0), ("samples", 2.0), ("passes", 1)):
        with pytest.raises(InputError, match=name):
            render_tile(scene, made, range(2), range(2), **{**tile, name: value})
    outside = ((range(5), range(2)), (range(2), range(0)), (range(2), range(-1, 2)), (range(2), range(0, 4, 2)))
    for rows, columns in outside:
        with pytest.raises(InputError, match="rows|columns"):
            render_tile(scene, made, rows, columns, **tile)
    with pytest.raises(InputError, match="samples.*at least 14"):
        render_tile(scene, technique("chapter"), range(2), range(2), **tile)


@pytest.mark.parametrize(
    ("name", "value"),
    [("subsamples", 0), ("background", -1.0), ("background", [1.0, 1.0]), ("dtype", torch.int32), ("v", "half")],
)
def test_bad_scenes(name, value):
    with pytest.raises(InputError, match=name):
        dataclasses.replace(support.scene(lit("furnace")), **{name: value})


def test_a_view_of_nothing_is_background():
    scene = support.scene(lit("furnace"), background=0.5)
    found = rendered(scene, where=(range(4), range(1)), samples=2, passes=2)
    assert bool((found.radiance == 0.5).all()) and int(found.samples.sum()) == 0
    empty = support.scene(lit("furnace"), width=1)
    with pytest.raises(InputError, match="at least one fibre"):
        rendered(empty, where=(range(4), range(1)), samples=2, passes=2)


def test_passes_are_independent():
    scene = support.scene(lit("lobe"), all_rays=True, subsamples=1, width=40, height=20)
    made = technique("uniform").prepare(scene)
    hits = scene.hits(range(20), range(40))
    sampler = made.at(hits, scene.contexts(hits))
    runs = torch.stack([
        integrator.estimate(sampler, made, hits.pixel, 4, 40, integrator.pass_seed(1, k)).sum(-1) for k in range(64)
    ])  # fmt: skip
    error = (runs - runs.mean(0)) / runs.std(0)
    assert abs(float((error[0] * error[1]).sum())) < 4 * len(hits) ** 0.5
    between = torch.corrcoef(error.T)  # of pixels, over passes
    off = between[~torch.eye(len(hits), dtype=torch.bool)]
    assert float(off.mean().abs()) < 0.01
