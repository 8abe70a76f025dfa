"""Public names change only together with the page that lists them."""

from support.public_names import page
from support.runs import ROOT


def test_public_names_are_those_of_the_page() -> None:
    published = (ROOT / "docs" / "public-names.md").read_text(encoding="utf-8")
    assert page() == published, "a public name changed: if that is meant, run `make docs` and tell users"
