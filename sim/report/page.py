"""The report's page: HTML of headings, tables, figures and verdicts, with its own style; text is escaped here."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import Final

from echelon.sim.results.records import Summary
from echelon.sim.results.summary import number

OUTCOMES: Final = {"passed": "holds", "failed": "fails", "not tested": "quiet"}
"""How the outcome of a check is marked in a table"""
LONG: Final = 24
"""A table's text of more characters may take several lines."""
STYLE: Final = """
:root{--ink:#26262b;--quiet:#70707a;--rule:#e3e3e8;--good:#0a7a55;--bad:#c02a23;
--sans:'Inter','Source Sans 3','Helvetica Neue',Arial,'Liberation Sans',sans-serif}
*{box-sizing:border-box}
body{margin:0 auto;padding:3rem 2.2rem 4rem;max-width:74rem;color:var(--ink);background:#fff;
font:15px/1.55 var(--sans);font-variant-numeric:tabular-nums}
h1{font-size:2rem;line-height:1.2;letter-spacing:-.02em;margin:0 0 .3rem;font-weight:650}
h2{font-size:1.18rem;letter-spacing:-.01em;margin:3.2rem 0 .3rem;padding-top:1rem;border-top:1px solid var(--rule)}
h3{font-size:.95rem;margin:1.2rem 0 .3rem;font-weight:600}
p{margin:.3rem 0 .8rem;max-width:48rem}.quiet,figcaption{color:var(--quiet)}
.lead{font-size:1.05rem}
.columns{display:grid;gap:1.4rem 2rem;grid-template-columns:repeat(auto-fit,minmax(min(100%,28rem),1fr))}
.columns>*{min-width:0}
figure{margin:.8rem 0;break-inside:avoid}figure svg{display:block;width:100%;height:auto}
figcaption{font-size:.84rem;line-height:1.45;margin-top:.4rem}
.verdict{border-left:4px solid var(--good);background:#f2f9f6;padding:.75rem 1.1rem;margin:1rem 0;break-inside:avoid}
.verdict.fails{border-color:var(--bad);background:#fdf4f3}
.verdict b{color:var(--good)}.verdict.fails b{color:var(--bad)}
.verdict ul{margin:.3rem 0 0;padding-left:1.1rem}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(8.6rem,1fr));gap:.2rem 1.4rem;margin:1rem 0 0}
.tile{border-top:1px solid var(--rule);padding:.5rem 0}
.tile span{display:block;font-size:.78rem;color:var(--quiet)}.tile strong{font-size:1.22rem;font-weight:600}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:.84rem;margin:.6rem 0;width:100%}
th{font-weight:600;color:var(--quiet);text-align:left;border-bottom:1.5px solid #b9b9c2;padding:.3rem .7rem .3rem 0}
td{border-bottom:1px solid var(--rule);padding:.26rem .7rem .26rem 0;white-space:nowrap}
.n{text-align:right}td.w{white-space:normal}tr{break-inside:avoid}
.holds{color:var(--good);font-weight:600}.fails td.mark,.mark.fails{color:var(--bad);font-weight:600}
pre{font:11.5px/1.5 ui-monospace,'DejaVu Sans Mono',Consolas,monospace;columns:2;column-gap:2.5rem;
white-space:pre-wrap;overflow-wrap:anywhere;margin:.8rem 0;color:#3c3c44}
@media(max-width:48rem){body{padding:1.4rem 1rem}pre{columns:1}}
@media print{@page{size:A4;margin:14mm}body{padding:0;max-width:none;font-size:9.5pt}
h2{break-after:avoid;margin-top:1.6rem}
.columns.pair{grid-template-columns:1fr 1fr}*{print-color-adjust:exact;-webkit-print-color-adjust:exact}}
"""


def page(title: str, parts: Iterable[str]) -> str:
    """Returns a whole document that needs nothing but itself."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def header(heading: str, description: str, facts: Sequence[str]) -> str:
    """Returns the page's head: what it is about, in a sentence, and a line of facts."""
    lead = f'<p class="lead">{escape(description)}</p>' if description else ""
    return f'<header><h1>{escape(heading)}</h1>{lead}<p class="quiet">{escape(" · ".join(facts))}</p></header>'


def side_by_side(cells: Sequence[str]) -> str:
    """Returns cells beside each other where there is room."""
    if len(cells) == 1:
        return cells[0]
    pair = " pair" if len(cells) == 2 else ""
    return f'<div class="columns{pair}">' + "".join(f"<div>{cell}</div>" for cell in cells) + "</div>"


def subheading(text: str) -> str:
    """Returns a heading within a section."""
    return f"<h3>{escape(text)}</h3>"


def paragraph(text: str) -> str:
    """Returns a paragraph."""
    return f"<p>{escape(text)}</p>"


def section(heading: str, text: str, cells: Sequence[str]) -> str:
    """Returns a section: heading, a word of explanation, and its cells side by side where there is room."""
    words = f'<p class="quiet">{escape(text)}</p>' if text else ""
    return f"<section><h2>{escape(heading)}</h2>{words}{side_by_side(cells)}</section>"


def figure(svg: str, alternative: str, caption: str) -> str:
    """Returns a figure; `alternative` says in words what it shows."""
    drawn = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(alternative)}" ', 1)
    return f"<figure>{drawn}<figcaption>{escape(caption)}</figcaption></figure>"


def verdict(name: str, summary: Summary) -> str:
    """Returns a run's verdict with its reasons, and what was not tested."""
    found = summary.verdict
    listed = "".join(f"<li>{escape(reason)}</li>" for reason in found.reasons)
    listed += "".join(f'<li class="quiet">not tested: {escape(text)}</li>' for text in found.not_tested)
    what = found.sentence.partition(": ")[2]
    return (
        f'<div class="verdict{" fails" if found.fails else ""}"><b>{found.word}</b> — {escape(name)}: {escape(what)}.'
        + (f"<ul>{listed}</ul>" if listed else "")
        + "</div>"
    )


def tiles(values: Sequence[tuple[str, str]]) -> str:
    """Returns the few numbers people look for first: what, how much."""
    return (
        '<div class="tiles">'
        + "".join(
            f'<div class="tile"><span>{escape(what)}</span><strong>{escape(value)}</strong></div>'
            for what, value in values
        )
        + "</div>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[object]], numeric_from: int = 1) -> str:
    """Returns a table; columns from `numeric_from` on are aligned right, None is a dash, True and False are words."""

    def cell(at: int, value: object) -> str:
        if isinstance(value, bool):
            return f'<td class="mark {"holds" if value else "fails"}">{"holds" if value else "fails"}</td>'
        if value in OUTCOMES:
            return f'<td class="mark {OUTCOMES[str(value)]}">{value}</td>'
        text = number(value) if isinstance(value, float) or value is None else str(value)
        kind = " class=n" if at >= numeric_from else " class=w" if len(text) > LONG else ""
        return f"<td{kind}>{escape(text)}</td>"

    header = "".join(
        f'<th scope="col"{" class=n" * (at >= numeric_from)}>{escape(name)}</th>' for at, name in enumerate(head)
    )
    body = "".join("<tr>" + "".join(cell(at, value) for at, value in enumerate(row)) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table></div>'


def preformatted(text: str) -> str:
    """Returns text as it stands."""
    return f"<pre>{escape(text.strip())}</pre>"
