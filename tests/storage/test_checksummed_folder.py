from pathlib import Path

import pytest

from ldo_service.errors import DataError
from ldo_service.storage.checksummed_folder import ChecksummedFolder

BODY = bytes(range(40))


def test_written_bodies_are_read_also_by_a_new_instance(tmp_path: Path) -> None:
    folder = ChecksummedFolder(tmp_path, "part", "")
    assert folder.write(7, BODY)
    assert folder.write(7, BODY[::-1])
    assert folder.write(123456789, b"")
    for each in (folder, ChecksummedFolder(tmp_path, "part", "")):
        assert bytes(each.read(7)) == BODY[::-1]
        assert bytes(each.read(123456789)) == b""
        assert each.sizes == {7: 48, 123456789: 8}
    assert ChecksummedFolder(tmp_path, "other", "").sizes == {}


def test_every_truncation_and_changed_byte_is_detected(tmp_path: Path) -> None:
    folder = ChecksummedFolder(tmp_path, "part", "")
    folder.write(1, BODY)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    cut = [whole[:n] for n in range(len(whole))]
    changed = [whole[:n] + bytes([whole[n] ^ 16]) + whole[n + 1 :] for n in range(len(whole))]
    for data in (*cut, *changed, whole + b"\0"):
        path.write_bytes(data)
        with pytest.raises(DataError, match="damaged"):
            folder.read(1)
    path.write_bytes(whole)
    assert bytes(folder.read(1)) == BODY


def test_removed_file_cannot_be_read(tmp_path: Path) -> None:
    folder = ChecksummedFolder(tmp_path, "part", "")
    folder.write(1, BODY)
    folder.remove(1)
    folder.remove(1)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(DataError, match="cannot be read"):
        folder.read(1)
