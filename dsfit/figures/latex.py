"""Plain text and tables as LaTeX that pdflatex sets with its standard packages."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dsfit.figures.table import Table

PACKAGES = ("array", "booktabs", "graphicx", "longtable")
"""What tables need; `longtable` only those of many rows."""

_ASCII = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "%": r"\%", "_": r"\_",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': r"\textquotedbl{}", "`": r"\textasciigrave{}",
}  # fmt: skip
_TEXT = {
    "–": "--", "—": "---", "…": r"\ldots{}", "‘": "`", "’": "'", "“": "``", "”": "''", "\u00a0": "~", "\u202f": r"\,",
    "\u2009": r"\,", "\u2060": "", "\u200b": "", "‑": "-", "‰": r"\textperthousand{}", "€": r"\texteuro{}",
    "§": r"\S{}", "©": r"\textcopyright{}", "·": r"\ensuremath{\cdot}", "°": r"\textdegree{}", "■": r"\rule{1ex}{1ex}",
}  # fmt: skip
_GREEK = {
    "α": "alpha", "β": "beta", "γ": "gamma", "δ": "delta", "ε": "varepsilon", "ϵ": "epsilon", "ζ": "zeta", "η": "eta",
    "θ": "theta", "ϑ": "vartheta", "ι": "iota", "κ": "kappa", "λ": "lambda", "μ": "mu", "µ": "mu", "ν": "nu",
    "ξ": "xi", "π": "pi", "ρ": "rho", "ς": "varsigma", "σ": "sigma", "τ": "tau", "υ": "upsilon", "φ": "varphi",
    "ϕ": "phi", "χ": "chi", "ψ": "psi", "ω": "omega", "Γ": "Gamma", "Δ": "Delta", "Θ": "Theta", "Λ": "Lambda",
    "Ξ": "Xi", "Π": "Pi", "Σ": "Sigma", "Υ": "Upsilon", "Φ": "Phi", "Ψ": "Psi", "Ω": "Omega",
}  # fmt: skip
_SIGNS = {
    "∫": "int", "∑": "sum", "∏": "prod", "√": r"surd", "∞": "infty", "∂": "partial", "∇": "nabla", "×": "times",
    "÷": "div", "±": "pm", "∓": "mp", "≤": "leq", "≥": "geq", "≠": "neq", "≈": "approx", "≡": "equiv", "≪": "ll",
    "≫": "gg", "∝": "propto", "∼": "sim", "≃": "simeq", "∈": "in", "∉": "notin", "∩": "cap", "∪": "cup",
    "⊂": "subset", "→": "to", "←": "leftarrow", "↑": "uparrow", "↓": "downarrow", "⇒": "Rightarrow", "↦": "mapsto",
    "↔": "leftrightarrow", "∘": "circ", "⋅": "cdot", "•": "bullet", "∗": "ast", "⟨": "langle", "⟩": "rangle",
    "‖": "Vert", "∀": "forall", "∃": "exists", "¬": "neg", "∧": "wedge", "∨": "vee", "⊥": "perp", "∥": "parallel",
    "′": "prime", "″": "prime\\prime", "ℓ": "ell", "∠": "angle", "⌊": "lfloor", "⌋": "rfloor", "⌈": "lceil",
    "⌉": "rceil", "∅": "emptyset", "△": "triangle", "▲": "triangle", "★": "star", "ℝ": "Re",
}  # fmt: skip
_RAISED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻⁼⁽⁾ⁿⁱᵀ", "0123456789+-=()niT")
_LOWERED = str.maketrans("₀₁₂₃₄₅₆₇₈₉₊₋₌₍₎ₐₑₒₓₔₕₖₗₘₙₚₛₜᵢᵣᵤᵥⱼ", "0123456789+-=()aeoxəhklmnpstiruvj")
_RUNS = re.compile(f"([{''.join(map(chr, _RAISED))}]+)|([{''.join(map(chr, _LOWERED))}]+)")
_MARKS = {
    "\u0300": "`", "\u0301": "'", "\u0302": "^", "\u0303": "~", "\u0304": "=", "\u0306": "u", "\u0307": ".",
    "\u0308": '"', "\u030a": "r", "\u030b": "H", "\u030c": "v", "\u0327": "c", "\u0328": "k",
}  # fmt: skip
_LETTERS = {"ß": r"\ss{}", "æ": r"\ae{}", "Æ": r"\AE{}", "ø": r"\o{}", "Ø": r"\O{}", "ł": r"\l{}", "œ": r"\oe{}"}
# ligatures of TeX's fonts that plain text does not mean: --set, ,, and ''
_LIGATURES = re.compile(r"(?<=-)(?=-)|(?<=,)(?=,)|(?<=')(?=')|(?<=[?!])(?=`)")


_SYMBOLS = re.compile(r"(?<![\w\\])([A-Za-zα-ωϑϕΑ-Ω])_([A-Za-z0-9]{1,3}|[θφσ])(?:\^([A-Za-z0-9]))?(?![\w(])")


def escape(text: str, *, symbols: bool = True) -> str:
    """The text as LaTeX in plain ASCII; a sign that is not known stands there as `[U+2603]` rather than stop TeX.

    Args:
        text: plain text.
        symbols: set a letter with an index, such as a_f or θ_r^2, as the formula that it is meant to be.
    """
    if symbols:
        pieces, end = [], 0
        for found in _SYMBOLS.finditer(text):
            pieces += [escape(text[end : found.start()], symbols=False), _symbol(*found.groups())]
            end = found.end()
        return "".join([*pieces, escape(text[end:], symbols=False)])
    pieces, end = [], 0
    for run in _RUNS.finditer(text):
        pieces.append(_plain(text[end : run.start()]))
        raised, end = run[1], run.end()
        body = raised.translate(_RAISED) if raised else run[2].translate(_LOWERED)
        pieces.append(rf"\ensuremath{{{'^' if raised else '_'}{{{body}}}}}")
    return "".join([*pieces, _plain(text[end:])])


def _symbol(letter: str, index: str, power: str | None) -> str:
    below = _plain(index) if len(index) == 1 else rf"\mathrm{{{index}}}"
    return rf"\ensuremath{{{_plain(letter)}_{{{below}}}" + (f"^{{{power}}}}}" if power else "}")


def _plain(text: str) -> str:
    words = _LIGATURES.sub("\u2060\u2060", " ".join(text.split("\n")))
    return "".join(map(_sign, words)).replace("{}{}", "{}")


def _sign(sign: str) -> str:
    if sign == "\u2060":
        return "{}"
    if sign in _ASCII:
        return _ASCII[sign]
    if " " <= sign <= "~":
        return sign
    if sign in _TEXT or sign in _LETTERS:
        return _TEXT.get(sign) or _LETTERS.get(sign, "")
    if sign in _GREEK or sign in _SIGNS:
        return rf"\ensuremath{{\{_GREEK.get(sign) or _SIGNS[sign]}}}"
    if sign in "−\t\r½¼¾":
        return {"−": r"\ensuremath{-}", "½": r"\textonehalf{}", "¼": r"\textonequarter{}"}.get(
            sign, r"\textthreequarters{}" if sign == "¾" else " "
        )
    base, *marks = unicodedata.normalize("NFD", sign)
    if marks and base.isascii() and all(mark in _MARKS for mark in marks):
        for mark in marks:
            base = rf"\{_MARKS[mark]}{{{base}}}"
        return base
    return f"[U+{ord(sign):04X}]"


# Signs that fit into 150 mm by size of type, gaps of columns counted as two: Latin Modern takes half an em for a sign.
_SIZES = ((r"\small", 84), (r"\footnotesize", 94), (r"\scriptsize", 106))
_WORDS = 34
_MOST_ROWS = 42


def table(content: Table, label: str) -> str:
    """The table as a float, or as a `longtable` where it has more rows than a page; its caption above.

    Columns of words wrap. What is wider all the same is shrunk to the width of the line, or, over several pages, set in
    smaller type.
    """
    longest = [max(len(str(row[k])) for row in (content.head, *content.rows)) for k in range(len(content.head))]
    signs = sum(longest) + 2 * len(longest)
    size = next((name for name, most in _SIZES if signs <= most), _SIZES[-1][0])
    columns = list(content.alignment)
    if signs > _SIZES[0][1] and (words := [k for k, n in enumerate(longest) if n > _WORDS]):
        size = r"\footnotesize"
        columns = _wrapped(columns, longest, words)
    head, rows = _row(content.head), [_row(row) for row in content.rows]
    made = (size, "".join(columns), head, rows, escape(content.caption), label)
    return _long(*made) if len(rows) > _MOST_ROWS else _float(*made)


def _wrapped(columns: list[str], longest: Sequence[int], words: Sequence[int]) -> list[str]:
    """Columns of words share what the others leave, by the roots of their lengths."""
    room = _SIZES[1][1] - 2 * len(columns) - sum(n for k, n in enumerate(longest) if k not in words)
    room = max(room, 16 * len(words))
    weights = {k: longest[k] ** 0.5 for k in words}
    for k in words:
        share = room * weights[k] / sum(weights.values()) / _SIZES[1][1]
        columns[k] = rf">{{\raggedright\arraybackslash}}p{{{share:.3f}\linewidth}}"
    return columns


def _row(cells: Sequence[str]) -> str:
    # braces keep a cell that begins with a bracket from being read as the length of the line break before it
    return " & ".join(escape(str(cell)) if str(cell)[:1] != "[" else f"{{{escape(str(cell))}}}" for cell in cells)


def _float(size: str, columns: str, head: str, rows: Sequence[str], caption: str, label: str) -> str:
    body = " \\\\\n".join(rows) + (" \\\\" if rows else "")
    return rf"""\begin{{table}}[htbp]
\centering
\caption{{{caption}}}
\label{{{label}}}
{size}
\sbox0{{\begin{{tabular}}{{{columns}}}
\toprule
{head} \\
\midrule
{body}
\bottomrule
\end{{tabular}}}}%
\ifdim\wd0>\linewidth\resizebox{{\linewidth}}{{!}}{{\usebox0}}\else\usebox0\fi
\end{{table}}
"""


def _long(size: str, columns: str, head: str, rows: Sequence[str], caption: str, label: str) -> str:
    body = " \\\\\n".join(rows)
    return rf"""\begingroup
{size}
\setlength\tabcolsep{{4pt}}
\begin{{longtable}}{{{columns}}}
\caption{{{caption}}}
\label{{{label}}} \\
\toprule
{head} \\
\midrule
\endfirsthead
\toprule
{head} \\
\midrule
\endhead
\bottomrule
\endfoot
{body} \\
\end{{longtable}}
\endgroup
"""
