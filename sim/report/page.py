"""The HTML of a report's page: headings, tables, figures and verdicts, with the style of page.css.  Only this module escapes
text."""

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Final

from echelon.sim.report.drawing import Picture
from echelon.sim.results.records import Summary
from echelon.sim.results.summary import number

OUTCOMES: Final = {"passed": "holds", "failed": "fails", "not tested": "quiet"}
"""The CSS class of an outcome in a table"""
LONG: Final = 24
"""A text in a table with more characters than this may take several lines."""
FOLDED: Final = 12
"""A table with more rows than this is folded."""
GENERATOR: Final = '<meta name="generator" content="echelon">'
"""A tag in the page's head by which programs recognise a report"""


def page(title: str, parts: Iterable[str]) -> str:
    """Returns a complete HTML document that needs no other files."""
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"{GENERATOR}<title>{escape(title)}</title><style>\n{style}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def header(heading: str, description: str, facts: Sequence[str]) -> str:
    """Returns the page's head: a heading, a description (may be empty), and a line of facts."""
    lead = f'<p class="lead">{escape(description)}</p>' if description else ""
    return f'<header><h1>{escape(heading)}</h1>{lead}<p class="quiet">{escape(" · ".join(facts))}</p></header>'


def side_by_side(cells: Sequence[str]) -> str:
    """Returns cells (HTML) beside each other if the page is wide enough, otherwise below each other."""
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
    """Returns a section: a heading, an explanation (may be empty), and cells (HTML) side by side."""
    words = f'<p class="quiet">{escape(text)}</p>' if text else ""
    return f"<section><h2>{escape(heading)}</h2>{words}{side_by_side(cells)}</section>"


def figure(picture: Picture, alternative: str, caption: str) -> str:
    """Returns a figure; `alternative` says in words what it shows."""
    drawn = picture.svg.replace("<svg ", f'<svg role="img" aria-label="{escape(alternative)}" ', 1)
    return f"<figure>{drawn}<figcaption>{escape(caption)}</figcaption></figure>"


def verdict(name: str, summary: Summary) -> str:
    """Returns a run's verdict with its reasons, and with the checks that were not tested."""
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
    """Returns a row of tiles, each with a word and a number: those that people look for first."""
    return (
        '<div class="tiles">'
        + "".join(
            f'<div class="tile"><span>{escape(what)}</span><strong>{escape(value)}</strong></div>'
            for what, value in values
        )
        + "</div>"
    )


def fold(words: str, content: str) -> str:
    """Returns content (HTML) that the reader unfolds by a click on `words`."""
    return f"<details><summary>{escape(words)}</summary>{content}</details>"


def table(head: Sequence[str], rows: Sequence[Sequence[object]], numeric_from: int = 1, what: str = "rows") -> str:
    """Returns a table.  Columns from number `numeric_from` on are aligned right; None becomes a dash, True `holds`, False
    `fails`.

    A table of more than `FOLDED` rows is folded, under words such as `60 robots`, where `what` is `robots`."""

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
    whole = f'<div class="scroll"><table><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table></div>'
    return whole if len(rows) <= FOLDED else fold(f"{len(rows)} {what}", whole)


def rest(count: int, shown: int) -> str:
    """Returns a paragraph that says how many rows a table leaves out that shows at most `shown` of `count`; empty if none."""
    return paragraph(f"{count - shown} more are in the summary.") if count > shown else ""


def preformatted(text: str) -> str:
    """Returns text with its line breaks and spaces."""
    return f"<pre>{escape(text.strip())}</pre>"
