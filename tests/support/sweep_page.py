"""docs/sweep.md with the columns of a sweep's tables: `make docs` writes it from the code, a test holds it against the code."""

from typing import Final

from echelon.sim.sweep.columns import markdown
from support.runs import ROOT

PAGE: Final = ROOT / "docs" / "sweep.md"
BEGIN: Final = "<!-- columns -->\n"
END: Final = "<!-- /columns -->"


def page() -> str:
    """Returns the page with today's columns."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{markdown()}\n{END}{rest.split(END)[1]}"


if __name__ == "__main__":
    print(page(), end="")
