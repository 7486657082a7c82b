"""A check of a data set as JUnit XML, which continuous integration shows as tests."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from nlosrender.analysis.comparison.dataset import CheckedFile, DatasetCheck
from nlosrender.files.atomic_write import replacing
from nlosrender.files.file_kinds import JUNIT
from nlosrender.readable import printable

MAX_MESSAGE = 2000  # characters; a capture with many bounces lists each of them


def write_junit(path: Path, check: DatasetCheck, folder: Path) -> None:
    """Write one test case for every capture of the reference: failed beyond a tolerance, an error if unreadable.

    Raises
    ------
    FileError
        The file cannot be written, or would replace one of another kind.
    """
    counts = {
        "tests": str(len(check.files)),
        "failures": str(len(check.with_status("exceeds")) + len(check.with_status("missing"))),
        "errors": str(len(check.with_status("unreadable"))),
        "time": f"{sum(file.seconds for file in check.files):.3f}",
    }
    root = ElementTree.Element("testsuites", {"name": "nlosrender check", **counts})
    suite = ElementTree.SubElement(root, "testsuite", {"name": printable(folder), **counts})
    for file in check.files:
        _add_case(suite, file, folder)
    if check.extra:
        listed = "".join(f"{printable(name)}: not in the reference\n" for name in check.extra)
        ElementTree.SubElement(suite, "system-out").text = listed
    ElementTree.indent(root)
    with replacing(path, JUNIT) as partial:
        ElementTree.ElementTree(root).write(partial, encoding="utf-8", xml_declaration=True)


def _add_case(suite: ElementTree.Element, file: CheckedFile, folder: Path) -> None:
    about = {"classname": printable(folder), "name": printable(file.name), "time": f"{file.seconds:.3f}"}
    case = ElementTree.SubElement(suite, "testcase", about)
    if file.status != "ok":
        kind = "error" if file.status == "unreadable" else "failure"
        message = printable(file.message, MAX_MESSAGE)
        ElementTree.SubElement(case, kind, {"type": file.status, "message": message}).text = message
