"""Proposals on disk: what is loaded works as what was saved, and nothing else is ever loaded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from dsfit.bsdf import DualScattering, Fiber
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment.store import _Reader, _Writer, load_proposal, save_proposal
from dsfit.proposals.azimuth import CosineHalf, WrappedGaussian
from dsfit.proposals.base import Distribution, Product, Proposal
from dsfit.proposals.chapter import chapter_proposals
from dsfit.proposals.gaussian_lobe import GaussianLobe
from dsfit.proposals.mixture import Mixture
from dsfit.proposals.structured import StructuredProposal


def example() -> Product:
    return Product(GaussianLobe(torch.tensor(-0.1), 0.2), WrappedGaussian(0.5))


def test_a_loaded_proposal_samples_and_evaluates_as_before(tmp_path: Path) -> None:
    proposal = example()
    save_proposal(tmp_path / "p.npz", proposal)
    loaded = load_proposal(tmp_path / "p.npz")
    u = torch.rand(50, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    context = Context(torch.tensor([0.0, 0.5, -1.0], dtype=torch.float64))
    for a, b in zip(proposal(context).sample_with_log_prob(u), loaded(context).sample_with_log_prob(u), strict=True):
        assert torch.equal(a, b)
    assert {k: (v.dtype, v.requires_grad) for k, v in proposal.named_parameters()} == {
        k: (v.dtype, v.requires_grad) for k, v in loaded.named_parameters()
    }
    loaded(context).log_prob(torch.zeros(3, 2, dtype=torch.float64)).sum().backward()
    assert all(p.grad is not None for p in loaded.parameters())


_BSDF = DualScattering(Fiber.preset("blond", eta=1.5))
_CONTEXT = Context(torch.tensor(0.3, dtype=torch.float64), 0.5, 2.0, 0.3)
_ALL = {
    **chapter_proposals(_BSDF),
    "mixture": Mixture([chapter_proposals(_BSDF)["R"], chapter_proposals(_BSDF)["back"]]),
    "structured": StructuredProposal(_BSDF, _CONTEXT),
}


@pytest.mark.parametrize("name", _ALL)
def test_every_proposal_comes_back(tmp_path: Path, name: str) -> None:
    proposal = _ALL[name]
    save_proposal(tmp_path / "p.npz", proposal)
    before, after = proposal(_CONTEXT), load_proposal(tmp_path / "p.npz")(_CONTEXT)
    u = torch.rand(200, before.dimension, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for a, b in zip(before.sample_with_log_prob(u), after.sample_with_log_prob(u), strict=True):
        assert torch.equal(a, b)


def test_fixed_values_stay_fixed_and_shared_parts_stay_shared(tmp_path: Path) -> None:
    lobe = GaussianLobe(0.0, 0.3, learnable=False)
    pair = nn.ModuleList([Product(lobe, CosineHalf()), Product(lobe, CosineHalf())])
    writer = _Writer()
    node = json.loads(json.dumps(writer.node(pair, "pair")))
    back = _Reader(writer.arrays).value(node)
    assert back[0].longitudinal is back[1].longitudinal
    assert not list(back.parameters())


def test_a_bsdf_is_stored_by_its_arguments() -> None:
    bsdf = DualScattering(Fiber.preset("brown", eta=1.5), d_f=0.6, azimuthal="raw", convention="printed")
    angles = [torch.tensor(x, dtype=torch.float64) for x in (0.1, 0.2, 2.5)]
    value = bsdf(*angles, 0.0, 1.0)
    writer = _Writer()
    back = _Reader(writer.arrays).value(json.loads(json.dumps(writer.node(bsdf, "bsdf"))))
    assert torch.equal(back(*angles, 0.0, 1.0), value)
    assert len(writer.arrays) < 15  # the fibre's fields, not the tables made from them


class _Foreign(Proposal):
    def forward(self, context: Context) -> Distribution:
        raise NotImplementedError


def test_what_cannot_be_saved_is_named(tmp_path: Path) -> None:
    proposal = example()
    proposal.hook = lambda x: x
    with pytest.raises(InputError, match=r"proposal\.hook"):
        save_proposal(tmp_path / "p.npz", proposal)
    with pytest.raises(InputError, match="_Foreign"):
        save_proposal(tmp_path / "p.npz", _Foreign())
    with pytest.raises(InputError, match="a dsfit Proposal"):
        save_proposal(tmp_path / "p.npz", nn.Linear(1, 1))
    assert not list(tmp_path.iterdir())


def test_every_truncation_and_flipped_byte_loads_or_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "p.npz"
    save_proposal(path, example())
    whole = path.read_bytes()
    for length in range(0, len(whole), 13):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"p\.npz"):
            load_proposal(path)
    refused = 0
    for position in range(0, len(whole), 5):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        try:
            load_proposal(path)
        except InputError as error:
            assert "p.npz" in str(error)
            refused += 1
    assert refused > 50


def _forge(path: Path, root: object, **header: object) -> None:
    full = {"format": "dsfit proposal", "schema_version": 1, "root": root, **header}
    np.savez(path, header=np.frombuffer(json.dumps(full).encode(), dtype=np.uint8))


@pytest.mark.parametrize(
    "root",
    [
        {"id": 0, "class": "os:path", "state": {}},
        {"id": 0, "name": "dsfit.experiment.files:os.system"},
        {"id": 0, "call": "dsfit.experiment.files:write_bytes", "with": {"path": "victim", "content": "x"}},
        {"id": 0, "partial": {"id": 1, "name": "builtins:eval"}, "args": {"list": ["1"]}, "keywords": {"dict": []}},
        {"id": 0, "class": "dsfit.nothing:Gone", "state": {}},
        {"id": 0, "class": "dsfit.proposals.base:Gone", "state": {}},
        {"same": 4},
        {"list": []},
        3,
        None,
        {},
    ],
)
def test_forged_files_are_refused(tmp_path: Path, root: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _forge(tmp_path / "p.npz", root)
    with pytest.raises(InputError, match=r"p\.npz: got .*saved by dsfit\.save_proposal"):
        load_proposal(tmp_path / "p.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


def test_other_schema_versions_are_named(tmp_path: Path) -> None:
    _forge(tmp_path / "p.npz", None, schema_version=99)
    with pytest.raises(InputError, match="schema version 99"):
        load_proposal(tmp_path / "p.npz")
    with pytest.raises(InputError, match="No such file"):
        load_proposal(tmp_path / "none.npz")
