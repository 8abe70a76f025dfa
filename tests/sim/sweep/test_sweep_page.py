"""The page about sweeps has the columns that tables have."""

from support.sweep_page import PAGE, page


def test_columns_are_those_of_the_page() -> None:
    assert page() == PAGE.read_text(encoding="utf-8"), (
        "a column changed: if that is meant, run `make docs` and tell users"
    )
