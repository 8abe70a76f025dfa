"""runtime.arrivals: members append to one file; a disk that is full costs the arrivals, not the run."""

from pathlib import Path

import pytest

from echelon.runtime.arrivals import FILE, RECORD, ArrivalFile, pack_arrival
from support.full_disk import fill


def test_members_append_to_one_file(tmp_path: Path) -> None:
    first, second = ArrivalFile(tmp_path), ArrivalFile(tmp_path)
    for number, file in enumerate((first, second, first)):
        file.write(pack_arrival(number, 1, -2, 3))
    first.write(b"")
    first.close()
    second.close()
    assert list(RECORD.iter_unpack((tmp_path / FILE).read_bytes())) == [(number, 1, -2, 3) for number in range(3)]


def test_a_full_disk_is_told_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = ArrivalFile(tmp_path)
    fill(file._file)
    for _ in range(3):
        file.write(pack_arrival(0, 0, 0, 0))
    file.close()
    assert capfd.readouterr().err == f"{tmp_path / FILE}: No space left on device; no further arrivals are noted\n"
