"""What a report holds, whatever it is written as."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from experiments.reporting import claims
from experiments.reporting.claims import Verdict
from experiments.reporting.questions import QUESTIONS, Asked
from experiments.reporting.results import Results
from experiments.reporting.tables import Table, narrowed

MEANINGLESS = "The smoke preset only shows that everything works: its numbers mean nothing, so no hypothesis is judged."


@dataclass(frozen=True)
class Report:
    experiment: str
    config: Mapping[str, Any]
    environment: Mapping[str, Any]
    rows: Results
    claims: Sequence[Verdict] = ()
    figures: Mapping[str, str] = field(default_factory=dict)  # path relative to the report → caption
    notes: Sequence[str] = ()  # sentences for the end of the page
    extra: Mapping[str, Any] = field(default_factory=dict)  # further keys of report.json
    head: str = ""  # title and introduction of the page, Markdown
    tables: Sequence[Table] = ()  # of the page and the terminal
    more_rows: Results = field(default_factory=Results)  # of rows.csv; report.json holds them in `extra`
    conclusion: Sequence[str] = ()  # sentences before that on hypotheses
    warnings: Sequence[str] = ()  # what a reader must know before any number

    @property
    def meaningless(self) -> bool:
        return self.config.get("preset") == "smoke"

    def conclusions(self) -> list[str]:
        """What the page begins with."""
        return [MEANINGLESS] if self.meaningless else [*self.conclusion, *claims.summary(self.claims)]

    @property
    def asked(self) -> Asked:
        return QUESTIONS.get(self.experiment, Asked(self.experiment))

    def main_table(self) -> Table | None:
        """The one table that is not folded, in few columns."""
        plain = [table for table in self.shown() if not (table.verdicts or table.folded)]
        named = [table for table in plain if self.asked.table in table.title] or plain
        return narrowed(named[0]) if named else None

    def folded_tables(self) -> list[Table]:
        """The other tables, and the main one if it has lost columns."""
        return [table for table in self.shown() if table != self.main_table()]

    def figures_in_order(self) -> dict[str, str]:
        """The figures, the main one first."""
        return dict(sorted(self.figures.items(), key=lambda item: item[0] != self.asked.figure))

    def shown(self) -> list[Table]:
        """The tables of the page; numbers that mean nothing have no verdicts."""
        return [table for table in self.tables if not (self.meaningless and table.verdicts)]

    def printed(self) -> list[Table]:
        """The tables of the terminal: of the hypotheses those alone that a quick run decides."""
        quick = self.config.get("preset") == "quick"
        return [claims.decided(table) if quick and table.verdicts else table for table in self.shown()]
