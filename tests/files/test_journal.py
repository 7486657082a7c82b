"""A record counts when all of it is on disk, and only then; one process at a time."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from nlosrender.files.partial.journal import Journal, JournalInUseError

RECORDS = [{"a": 1}, {"text": "line\nbreak é", "list": [1, 2.5, None]}, {"b": "x" * 300}]


def written(path: Path) -> bytes:
    journal = Journal(path)
    for record in RECORDS:
        journal.append(record)
    journal.close()
    return path.read_bytes()


def test_a_journal_cut_off_at_any_byte_holds_the_records_before(tmp_path: Path) -> None:
    """What was cut off never happened, and a new record after it is read back."""
    whole = written(tmp_path / "journal")
    ends = [index + 1 for index, byte in enumerate(whole) if byte == ord("\n")]
    assert len(ends) == len(RECORDS)
    for length in range(len(whole) + 1):
        (tmp_path / "cut").write_bytes(whole[:length])
        journal = Journal(tmp_path / "cut")
        journal.append({"new": 1})
        kept = sum(end <= length for end in ends)
        assert list(journal.records()) == [*RECORDS[:kept], {"new": 1}]
        journal.close()


@pytest.mark.parametrize("at", [0, 9, 20, 30])
def test_a_flipped_bit_ends_the_journal(tmp_path: Path, at: int) -> None:
    """A damaged record and everything after it never happened."""
    content = bytearray(written(tmp_path / "journal"))
    content[at] ^= 4
    (tmp_path / "journal").write_bytes(content)
    journal = Journal(tmp_path / "journal")
    assert list(journal.records()) == RECORDS[: at > content.index(b"\n")]
    journal.close()


def test_what_follows_damage_never_comes_back(tmp_path: Path) -> None:
    """A record as long as the damaged one does not make those behind it count again."""
    content = bytearray(written(tmp_path / "journal"))
    content[12] ^= 1  # in the first record
    (tmp_path / "journal").write_bytes(content)
    journal = Journal(tmp_path / "journal")
    assert list(journal.records()) == []
    journal.append({"b": 1})  # as long as {"a": 1}
    assert list(journal.records()) == [{"b": 1}]
    journal.close()


def test_a_journal_is_open_once(tmp_path: Path) -> None:
    """Another one is refused, until the first is closed."""
    first = Journal(tmp_path / "journal")
    with pytest.raises(JournalInUseError):
        Journal(tmp_path / "journal")
    first.close()
    Journal(tmp_path / "journal").close()


def test_a_killed_process_leaves_no_lock(tmp_path: Path) -> None:
    """The lock goes with the process that held it."""
    code = (
        "import os, signal, sys; from pathlib import Path; from nlosrender.files.partial.journal import Journal\n"
        "j = Journal(Path(sys.argv[1])); j.append({'a': 1}); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "journal")], check=False)
    assert done.returncode == -9
    journal = Journal(tmp_path / "journal")
    assert list(journal.records()) == [{"a": 1}]
    journal.close()


def test_a_disk_that_fills_up_loses_the_record_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a record on a full disk never happened; the next one takes its place."""
    import os

    journal = Journal(tmp_path / "journal")
    journal.append(RECORDS[0])
    true_write = os.pwrite
    taken: list[int] = []

    def full(descriptor: int, content: bytes, offset: int) -> int:
        if taken:
            raise OSError(28, "No space left on device")
        taken.append(true_write(descriptor, content[:40], offset))
        return taken[-1]

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        with pytest.raises(OSError, match="No space"):
            journal.append(RECORDS[2])
    journal.append({"short": 1})
    journal.append({"next": 1})
    journal.close()
    journal = Journal(tmp_path / "journal")
    assert list(journal.records()) == [RECORDS[0], {"short": 1}, {"next": 1}]
    journal.close()
