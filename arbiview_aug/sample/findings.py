"""Findings of ``check``, as plain data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One probable mistake.

    Attributes:
        where: The camera or key.
        expected: The right value.
        found: The sample's value.
        fix: The step that mends it.
    """

    where: str
    expected: str
    found: str
    fix: str

    def __str__(self) -> str:
        return f"{self.where}: expected {self.expected}, found {self.found}; {self.fix}"


@dataclass(frozen=True)
class CheckReport:
    """The findings of ``check``; ``print`` shows one line each."""

    findings: tuple[Finding, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def __str__(self) -> str:
        return "\n".join(map(str, self.findings)) or "no findings"
