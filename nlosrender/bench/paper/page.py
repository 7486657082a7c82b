"""One HTML page that shows every figure beside what the paper reports; nothing in it comes from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from nlosrender.bench.paper.figure import PaperFigure, Table, relative_name
from nlosrender.files.atomic_write import replacing
from nlosrender.files.file_kinds import PAGE, REPORT

STYLE = """
body{margin:0 auto;max-width:1080px;padding:24px;background:#0e0f14;color:#e8e8ee;font:16px/1.5 system-ui,sans-serif}
h1{font-size:26px}h2{margin-top:56px;border-top:1px solid #34363f;padding-top:18px;font-size:20px}
p{max-width:76ch}.faint,figcaption,caption{color:#8b8d98;font-size:14px}
figure{margin:18px 0}img{max-width:100%;border:1px solid #34363f}
dl{display:grid;grid-template-columns:110px 1fr;gap:6px 16px;max-width:100ch}dt{color:#8b8d98}dd{margin:0}
.table{overflow-x:auto}table{border-collapse:collapse;font-size:14px;margin:14px 0}
th,td{padding:4px 12px;text-align:left;border-bottom:1px solid #34363f;white-space:nowrap}
caption{text-align:left;padding-bottom:6px}
.yes::before{content:"\\2713  ";color:#7fd6ff}.no::before{content:"\\2717  ";color:#ff7f7f}
code{color:#7fd6ff}
"""
INTRODUCTION = (
    "Royo, Garc\u00eda, Mu\u00f1oz, Jarabo: Non-line-of-sight transient rendering, Computers & Graphics 107 (2022), "
    "reproduced by nlosrender. Every number below was computed by the run that made this page."
)


def write_page(figures: Sequence[PaperFigure], folder: Path, facts: dict[str, Any]) -> Path:
    """Write ``index.html`` and ``paper.json``.

    Parameters
    ----------
    figures
        In the order of the page.
    folder
        Where; pictures lie below it.
    facts
        About the run: plain values.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    FileError
        It cannot be written.
    """
    body = [f"<h1>The paper, reproduced</h1><p>{escape(INTRODUCTION)}</p>"]
    body.append(f"<p class=faint>{escape(', '.join(f'{key}: {value}' for key, value in facts.items()))}</p>")
    body += [_section(figure, folder) for figure in figures]
    text = f"<!doctype html><html lang=en><meta charset=utf-8><title>nlosrender: the paper, reproduced</title>\
<meta name=viewport content='width=device-width'><style>{STYLE}</style><body>{''.join(body)}</body></html>"
    page = folder / "index.html"
    report = {"facts": facts, "figures": [figure.report(folder) for figure in figures]}
    with replacing(page, PAGE) as partial:
        partial.write_text(text, encoding="utf-8")
    with replacing(folder / "paper.json", REPORT) as partial:
        partial.write_text(json.dumps(report, indent=1), encoding="utf-8")
    return page


def _section(figure: PaperFigure, folder: Path) -> str:
    parts = [f"<h2>{escape(figure.name)}: {escape(figure.title)}</h2>"]
    facts = [("paper", figure.reported), ("measured", figure.measured), ("differs", figure.differs)]
    rows = "".join(f"<dt>{name}</dt><dd>{escape(text)}</dd>" for name, text in facts if text)
    checks = "".join(
        f"<div class={'yes' if check.holds else 'no'}>{escape(check.statement)}</div>" for check in figure.checks
    )
    parts.append(f"<dl>{rows}{f'<dt>checks</dt><dd>{checks}</dd>' if checks else ''}</dl>")
    parts += [_table(table) for table in figure.tables]
    for picture in figure.pictures:
        source = escape(relative_name(picture.path, folder), quote=True)
        parts.append(
            f"<figure><img src='{source}' alt='{escape(picture.caption, quote=True)}'>"
            f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
        )
    names = ", ".join(f"{name}.yaml" for name in figure.configurations)
    parts.append(f"<p class=faint>{escape(names)}; seed {figure.seed}; {figure.seconds:.1f} s in all</p>")
    return "".join(parts)


def _table(table: Table) -> str:
    head = f"<caption>{escape(table.caption)}</caption><tr>{_cells(table.columns, 'th')}</tr>"
    return f"<div class=table><table>{head}{''.join(f'<tr>{_cells(row)}</tr>' for row in table.rows)}</table></div>"


def _cells(row: Iterable[str], tag: str = "td") -> str:
    return "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in row)
