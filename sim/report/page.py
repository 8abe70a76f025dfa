"""The report's page: HTML of headings, tables, figures and verdicts, styled by page.css; text is escaped here."""

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Final

from echelon.sim.report.drawing import Picture
from echelon.sim.results.records import Summary
from echelon.sim.results.summary import number

OUTCOMES: Final = {"passed": "holds", "failed": "fails", "not tested": "quiet"}
"""How the outcome of a check is marked in a table"""
LONG: Final = 24
"""A table's text of more characters may take several lines."""
FOLDED: Final = 12
"""A table of more rows is folded."""
GENERATOR: Final = '<meta name="generator" content="echelon">'
"""By which a report is known to be one"""


def page(title: str, parts: Iterable[str]) -> str:
    """Returns a whole document that needs nothing but itself."""
    style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"{GENERATOR}<title>{escape(title)}</title><style>\n{style}</style></head>\n<body>\n"
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


def figure(picture: Picture, alternative: str, caption: str) -> str:
    """Returns a figure; `alternative` says in words what it shows."""
    drawn = picture.svg.replace("<svg ", f'<svg role="img" aria-label="{escape(alternative)}" ', 1)
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


def fold(words: str, content: str) -> str:
    """Returns what is shown once it is unfolded."""
    return f"<details><summary>{escape(words)}</summary>{content}</details>"


def table(head: Sequence[str], rows: Sequence[Sequence[object]], numeric_from: int = 1, what: str = "rows") -> str:
    """Returns a table; columns from `numeric_from` on are aligned right, None is a dash, True and False are words.

    A long one is folded, and says how many of `what` are in it."""

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
    """Returns how many rows a table of `count` lacks because it shows `shown` at most."""
    return paragraph(f"{count - shown} more are in the summary.") if count > shown else ""


def preformatted(text: str) -> str:
    """Returns text as it stands."""
    return f"<pre>{escape(text.strip())}</pre>"
