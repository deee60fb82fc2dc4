"""Configs of every kind, small enough to run in a second or so."""

from __future__ import annotations

_ESTIMATE = """
[estimate]
samples = [16, 64]
repeats = 4
rounds = 2
rtol = 1e-2
"""
_METHODS = """
[[methods]]
name = "uniform"
kind = "uniform"
[[methods]]
name = "mix of two"
kind = "heuristic_mix"
proposals = ["TT", "uniform"]
"""
_SCENE = """
[bsdf]
azimuthal = "simplified"
precision = "exact"
[geometry]
kind = "block"
options = { strands = 60, points = 6 }
radius_factor = 4.0
[camera]
width = 16
height = 12
[grid]
resolution = 6
"""
CONFIGS = {
    "compare": f"""
title = "Two methods <b>beside</b> each other"
[bsdf]
azimuthal = "simplified"
[contexts]
theta_r_deg = [0, 30]
[output]
maps = 0
{_METHODS}{_ESTIMATE}
""",
    "sweep": f"""
kind = "sweep"
[bsdf]
azimuthal = "simplified"
[output]
maps = 0
[sweep.grid]
"fiber.eta" = [1.45, 1.55]
{_METHODS}{_ESTIMATE}
""",
    "transmittance": """
kind = "transmittance"
[bsdf]
azimuthal = "simplified"
[transmittance]
n = [1, 3]
""",
    "check": """
kind = "check"
title = "a check"
[bsdf]
azimuthal = "simplified"
[check]
suites = ["chi_square"]
proposals = ["uniform"]
[check.chi_square]
samples = 2000
""",
    "race": """
kind = "race"
title = "a small race"
[bsdf]
azimuthal = "simplified"
[contexts]
theta_r_deg = [20]
n = [0, 3]
[estimate]
dtype = "float32"
rtol = 1e-4
[race]
implementation = "eager"
budgets = [0.01, 1000.0]
[race.stream]
count = 100
batch = 100
seconds = 0.02
fewest = 8
[race.single]
seconds = 0.02
seeds = 16
[[race.peers]]
name = "uniform sphere"
kind = "uniform"
[[race.peers]]
name = "two of the chapter's"
kind = "chapter"
options = { proposals = ["back", "uniform"] }
""",
    "amortise": """
kind = "amortise"
[amortise]
steps = 2
hidden = [4]
inclinations = 3
pairs = 2
check = 0
""",
    "render": f"""
kind = "render"
title = "a small picture"
{_SCENE}
[render]
subsamples = 2
samples = 2
passes = 2
tile = 16
technique = {{ kind = "uniform", light = 0.0 }}
""",
    "compare_render": f"""
kind = "compare_render"
title = "a small comparison"
{_SCENE}
[render]
dtype = "float64"
[compare]
width = 16
subsamples = 2
seconds = 0.05
equal_seconds = 0.02
equal_samples = 8
crop = [0.2, 0.2, 0.7, 0.8]
[compare.reference]
technique = {{ kind = "chapter", options = {{ model = "one" }}, light = 0.3 }}
samples = 32
passes = 8
check = {{ kind = "uniform" }}
check_samples = 32
check_passes = 8
[[compare.techniques]]
name = "uniform"
kind = "uniform"
uniforms = "random"
[[compare.techniques]]
name = "chapter, Sobol"
kind = "chapter"
options = {{ model = "one" }}
""",
}
