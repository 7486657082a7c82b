"""Tolerances of single files of a data set, from a YAML file that maps names or patterns to tolerances."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from nlosrender.analysis.comparison.captures import Tolerances
from nlosrender.config.fields import Flag, NonNegative, OpenUnit
from nlosrender.config.issues import shown
from nlosrender.config.load import in_order, validated, yaml_text
from nlosrender.config.section import Section
from nlosrender.config.yaml_tree import read_document
from nlosrender.errors import ConfigError, ValidationIssue


class FileTolerances(Section):
    """What may differ in a file; without any tolerance it has to be equal up to rounding."""

    max_rel_l2: NonNegative | None = None
    """largest relative L2 of the difference"""
    max_energy: NonNegative | None = None
    """largest relative difference of the energy, in total and of every bounce"""
    max_shift: NonNegative | None = None
    """largest shift in time [bins], in total and of every laser point"""
    z_test: Flag = False
    """allow what noise explains, by the stored variances"""
    significance: OpenUnit = 0.01
    """chance that the Z-test raises an alarm where both files show the same"""

    @property
    def tolerances(self) -> Tolerances:
        """The same as options of the command line give."""
        significance = self.significance if self.z_test else None
        return Tolerances(self.max_rel_l2, self.max_energy, self.max_shift, significance)


@dataclass(frozen=True)
class ToleranceRule:
    """The tolerances of files whose name, relative to the folder, is ``pattern`` or matches it."""

    pattern: str  # * matches slashes too
    tolerances: Tolerances
    place: str  # of the pattern in its file

    def applies(self, name: str) -> bool:
        """Return whether the rule is about a file."""
        return name == self.pattern or fnmatchcase(name, self.pattern)


def load_rules(path: Path) -> tuple[ToleranceRule, ...]:
    """Read ``{pattern: {max_rel_l2: ...}}``.

    Raises
    ------
    ConfigError
        With every issue found: the file cannot be read, is no YAML mapping, or a tolerance is none.
    """
    document = read_document(yaml_text(path)[0], str(path), path.absolute().parent)
    if not isinstance(document.tree, dict) or not document.tree:
        message = f"got {shown(document.tree)}, need a mapping such as letters/*.hdf5: {{max_rel_l2: 0.01}}."
        raise ConfigError(document.issues or ValidationIssue((), message, place=document.place(()) or str(path)))
    rules, issues = [], []
    for pattern, tree in document.tree.items():
        section, found = validated(FileTolerances, tree, document, (pattern,))
        issues += found
        if not found:
            rules.append(ToleranceRule(pattern, section.tolerances, document.place((pattern,), "key")))
    if issues or document.issues:
        raise ConfigError(in_order(issues, document))
    return tuple(rules)


def tolerances_of(name: str, rules: Sequence[ToleranceRule], otherwise: Tolerances) -> Tolerances:
    """Return the tolerances of the first rule that applies to a file."""
    return next((rule.tolerances for rule in rules if rule.applies(name)), otherwise)


def refuse_idle_rules(rules: Sequence[ToleranceRule], names: Iterable[str], folder: Path) -> None:
    """Refuse rules that decide about no file: a slip of the pen in a pattern would leave other tolerances to it.

    Raises
    ------
    ConfigError
        With every such rule.
    """
    deciding = {next((rule for rule in rules if rule.applies(name)), None) for name in names}
    issues = [
        ValidationIssue(
            (),
            f"{shown(rule.pattern)}: no capture below {folder} is left for it: none matches, or an earlier pattern "
            "takes them. Correct the pattern, remove it, or move it up.",
            place=rule.place,
        )
        for rule in rules
        if rule not in deciding
    ]
    if issues:
        raise ConfigError(issues)
