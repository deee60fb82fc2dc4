"""What a cell leaves in the table: its rows, one per method, finding, n or group of contexts.

Columns whose name has "seconds" in it are measured; all others repeat, whatever computes them, wherever.
"""

from __future__ import annotations

from typing import Any

from dsfit.experiment.files import number

Columns = dict[str, str]
"""name -> "int", "float", "bool", "text", "floats" or "texts"; every column may be null."""

CONTEXT: Columns = {"theta_r_deg": "float", "phi_r_deg": "float", "n": "float", "v": "float"}

_COMPARE: Columns = {
    "method": "text", "method_kind": "text", "excess": "float", "excess_error": "float", "variance": "float",
    "largest_weight": "float", "strategies": "texts", "fractions": "floats", "heuristic": "text", "samples": "int",
    "rmse": "float", "rmse_error": "float", "predicted_rmse": "float", "predicted_over_measured": "float",
    "samples_to_1_percent": "float", "fit_steps": "int", "fit_converged": "bool", "fit_excess_at_nodes": "float",
    "reference_norm": "float", "reference_norm_error": "float", "reference_converged": "bool",
    "seconds_per_sample": "float", "seconds_to_1_percent": "float", "fit_seconds": "float",
}  # fmt: skip
_TRANSMITTANCE: Columns = {
    "n": "float", "mean_deg": "float", "std_deg": "float", "centre_deg": "float", "width_deg": "float",
    "width_centred_deg": "float", "excess": "float", "excess_centred": "float", "excess_cosine": "float",
    "converged": "bool", "at_bounds": "texts",
}  # fmt: skip
_AMORTISE: Columns = {
    "group": "text", "contexts": "int", "excess_median": "float", "excess_p95": "float", "excess_p99": "float",
    "excess_worst": "float", "largest_weight": "float", "training_steps": "int", "training_contexts": "int",
    "parameters": "int", "training_seconds": "float",
}  # fmt: skip
_CHECK: Columns = {
    "suite": "text", "part": "text", "subject": "text", "case": "text", "p_value": "float", "value": "float",
    "bound": "float", "unclear": "text", "detail": "text",
}  # fmt: skip
_BY_KIND = {
    "compare": {**CONTEXT, **_COMPARE},
    "sweep": {**CONTEXT, **_COMPARE},
    "transmittance": _TRANSMITTANCE,
    "amortise": _AMORTISE,
    "check": {**CONTEXT, **_CHECK},
}


def columns(kind: str) -> Columns:
    """The columns of a kind of config, beside those of the design, of the cell and of failures."""
    return _BY_KIND[kind]


def rows(kind: str, data: dict[str, Any]) -> list[list[Any]]:
    """The rows of one cell from its data, each a list in the order of `columns`; null is None.

    Seconds come from the same data; a number that is not finite stays so.
    """
    made = {"compare": _compare, "sweep": _compare, "transmittance": _transmittance, "amortise": _amortise}
    found = made.get(kind, _check)(data)
    return [[_value(row.get(name), what) for name, what in columns(kind).items()] for row in found]


def context_of(kind: str, work: dict[str, Any]) -> list[Any]:
    """The context columns' values in a cell that failed."""
    context = work.get("context") or {}
    return [context.get(name) for name in columns(kind) if name in CONTEXT and kind != "transmittance"]


def _value(value: Any, what: str) -> Any:
    if value is None:
        return None
    if what == "float":
        return number(value)
    if what in ("floats", "texts"):
        return [number(x) if what == "floats" else str(x) for x in value]
    return {"int": int, "bool": bool, "text": str}[what](value)


def _place(data: dict[str, Any]) -> dict[str, Any]:
    """Inclination and azimuth as asked for, n and v as used (they may come from the scattering)."""
    asked, used = data["identity"].get("context") or {}, data.get("context") or {}
    found = {name: asked.get(name) for name in CONTEXT}
    return {**found, **{name: used[name] for name in ("n", "v") if name in used}}


def _compare(data: dict[str, Any]) -> list[dict[str, Any]]:
    shared = {**_place(data), **{f"reference_{k}": data["reference"][k] for k in ("norm", "norm_error", "converged")}}
    found = []
    for method in data["methods"]:
        fit, last = method.get("fit") or {}, method["estimates"][-1]
        heuristic = method["heuristic"]
        found.append(
            {
                **method,
                **shared,
                **{key: last[key] for key in ("samples", "rmse", "rmse_error", "predicted_rmse")},
                "method": method["name"],
                "method_kind": method["kind"],
                "heuristic": heuristic["kind"] if isinstance(heuristic, dict) else heuristic,
                "fit_steps": fit.get("steps"),
                "fit_converged": fit.get("converged"),
                "fit_excess_at_nodes": fit.get("excess_at_nodes"),
                "fit_seconds": fit.get("seconds"),
            }
        )
    return found


def _transmittance(data: dict[str, Any]) -> list[dict[str, Any]]:
    return list(data["fits"])


def _amortise(data: dict[str, Any]) -> list[dict[str, Any]]:
    training = data["training"]
    shared = {f"training_{key}": training[key] for key in ("steps", "contexts")}
    shared |= {"parameters": training["parameters"], "training_seconds": training["seconds"]["total"]}
    return [
        {
            **shared,
            "group": group,
            "contexts": data[group]["contexts"],
            "largest_weight": data[group]["largest_weight"],
            **{f"excess_{key}": data[group][key] for key in ("median", "p95", "p99", "worst")},
        }
        for group in ("start", "held_out")
    ]


def _check(data: dict[str, Any]) -> list[dict[str, Any]]:
    shared = {**_place(data), "part": data["identity"]["part"]}
    return [{**finding, **shared} for finding in data["findings"]]
