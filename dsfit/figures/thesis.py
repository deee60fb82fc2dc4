"""A LaTeX document with every figure and table, which pdflatex compiles where it lies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dsfit.figures.latex import escape
from dsfit.figures.state import in_order

_PREAMBLE = r"""% Compile with pdflatex (twice) in this folder.
\documentclass[11pt,a4paper]{article}
\usepackage[T1]{fontenc}
\usepackage{lmodern,textcomp}
\usepackage[textwidth=150mm,textheight=230mm]{geometry}
\usepackage{array,booktabs,graphicx,longtable,pgf}
\usepackage[tableposition=top,font=small,labelfont=bf,width=0.94\linewidth]{caption}
\def\mathdefault#1{#1}
% \dsfitpgftrue takes figures as PGF, in the type of the document, where they were drawn with --pgf.
\newif\ifdsfitpgf \dsfitpgf@WHICH@
% \dsfitfigure{folder/}{name}: at its own size, smaller where it is larger than the page.
\newsavebox\dsfitbox
\newcommand\dsfitfigure[2]{{\graphicspath{{#1}}%
  \sbox\dsfitbox{\ifdsfitpgf\IfFileExists{#1#2.pgf}{\input{#1#2.pgf}}{\includegraphics{#1#2.pdf}}%
    \else\includegraphics{#1#2.pdf}\fi}%
  \ifdim\wd\dsfitbox>\linewidth\sbox\dsfitbox{\resizebox{\linewidth}{!}{\usebox\dsfitbox}}\fi
  \ifdim\ht\dsfitbox>0.85\textheight\sbox\dsfitbox{\resizebox{!}{0.85\textheight}{\usebox\dsfitbox}}\fi
  \usebox\dsfitbox}}
\setcounter{totalnumber}{6}\setcounter{topnumber}{4}\setcounter{bottomnumber}{4}
\renewcommand\topfraction{0.95}\renewcommand\bottomfraction{0.95}\renewcommand\textfraction{0.02}
\renewcommand\floatpagefraction{0.6}
\title{Figures and tables}
\date{}
\begin{document}
\maketitle
\tableofcontents
"""


def thesis(experiments: Mapping[str, Mapping[str, Any]]) -> str:
    """The document.

    Args:
        experiments: by name, what is known of their drawings (`drawn.json`): title, shows, rules, figures, tables.
    """
    pgf = any(drawn.get("pgf") for drawn in experiments.values())
    body = "\n".join(_section(name, drawn) for name, drawn in experiments.items())
    return f"{_PREAMBLE.replace('@WHICH@', 'true' if pgf else 'false')}{body}\n\\end{{document}}\n"


def _section(name: str, drawn: Mapping[str, Any]) -> str:
    parts = [
        rf"\clearpage\section{{{escape(drawn['title'])}}}",
        f"{escape(drawn['shows'])} Made by \\texttt{{dsfit figures run {escape(name, symbols=False)}}}.",
        _reproduced(drawn["reproduces"]),
    ]
    parts += [_figure(name, figure, drawn["figures"][figure]["caption"]) for figure in in_order(drawn["figures"])]
    parts += [rf"\input{{{name}/tables/{table}.tex}}" for table in in_order(drawn["tables"])]
    return "\n\n".join(parts) + "\n"


def _reproduced(rules: Mapping[str, str]) -> str:
    """What "reproduced" means, rule by rule."""
    by_rule: dict[str, list[str]] = {}
    for pattern, rule in rules.items():
        by_rule.setdefault(rule, []).append(pattern)
    said = []
    for rule, patterns in by_rule.items():
        names = ", ".join(rf"\texttt{{{escape(pattern, symbols=False)}}}" for pattern in patterns)
        said.append(f"{names} {escape(rule)}")
    return "\\begin{sloppypar}Reproduced means: " + "; ".join([*said, "all else equal"]) + ".\\end{sloppypar}"


def _figure(name: str, figure: str, caption: str) -> str:
    return rf"""\begin{{figure}}[htbp]
\centering
\dsfitfigure{{{name}/figures/}}{{{figure}}}
\caption{{{escape(caption)}}}
\label{{fig:{name}:{figure}}}
\end{{figure}}"""
