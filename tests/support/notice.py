"""What could not be tested on this machine is said at the end of a run of pytest; a line in the list of skips is easily
overlooked."""

import pytest


class Notice:
    """Tells at the end of the run what was not tested, and why."""

    def __init__(self, what: str, why: str) -> None:
        self._what, self._why = what, why

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        terminalreporter.section(f"NOT TESTED: {self._what}", red=True, bold=True)
        terminalreporter.line(self._why)


def say_not_tested(config: pytest.Config, what: str, why: str) -> None:
    """Says at the end of the run that something was not tested; the same only once."""
    if not config.pluginmanager.has_plugin(what):
        config.pluginmanager.register(Notice(what, why), what)
