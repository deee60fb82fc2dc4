"""Where compiled code is kept."""

from __future__ import annotations

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from dsfit.kernels import compiler
from tests.kernels import cases

SOURCE = 'extern "C" int seven() { return 7; }\n'


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(compiler.tempfile, "gettempdir", lambda: str(tmp_path))
    return tmp_path / "cache" / "dsfit" / "kernels"


def test_the_cache_is_private(cache: Path) -> None:
    assert compiler.cache() == cache
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700


def test_files_that_may_be_others_are_not_loaded(cache: Path) -> None:
    cache.mkdir(parents=True)
    (cache / "planted.so").write_text("")
    cache.chmod(0o777)
    assert compiler.cache() == cache
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    assert not list(cache.iterdir())


def test_a_link_is_not_followed(cache: Path, tmp_path: Path) -> None:
    cache.parent.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    cache.symlink_to(tmp_path / "elsewhere")
    assert compiler.cache() == tmp_path / f"dsfit-kernels-{os.getuid()}"
    (tmp_path / f"dsfit-kernels-{os.getuid()}").rmdir()
    (tmp_path / f"dsfit-kernels-{os.getuid()}").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(compiler.NoCompiler, match="kept"):
        compiler.built(SOURCE if cases.has_compiler() else "")


@pytest.mark.skipif(not cases.has_compiler(), reason="no C++ compiler")
def test_builds_at_the_same_time_do_not_collide(cache: Path) -> None:
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(compiler.built, [SOURCE] * 4))
    assert [code.seven() for code in found] == [7] * 4
    assert [path.suffix for path in cache.iterdir()] == [".so"]
