"""C6, the input half: byte order marks, line ends and encodings change nothing or are named."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent))

import hostile

from ghpt.errors import GhptDataError

BINARY = ("npz", "npy", "freemocap", "colmap", "opencap", "sleap", "sleap_labels", "deeplabcut")
TEXTS = [name for name in hostile.FORMATS if name not in BINARY]
ENCODED = {
    "UTF-8 with a mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "CRLF and a mark": lambda text: b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode(),
    "UTF-16, little": lambda text: b"\xff\xfe" + text.encode("utf-16-le"),
    "UTF-16, big": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "UTF-16 without a mark": lambda text: text.encode("utf-16-le"),
    "Latin-1": lambda text: text.encode() + b"\xe9\n",
}
READ = ("UTF-8 with a mark", "CRLF", "CRLF and a mark")


@pytest.mark.parametrize("encoding", ENCODED)
def test_a_text_of_any_encoding_is_read_or_named(encoding, tmp_path, record_row):
    passed = 0
    for name in TEXTS:
        form, folder = hostile.FORMATS[name], tmp_path / name
        folder.mkdir()
        target = form.write(folder)
        whole = form.read(folder)
        target.write_bytes(ENCODED[encoding](target.read_text()))
        try:
            good = hostile.same(form.read(folder), whole)
        except GhptDataError as error:
            good = encoding not in READ and target.name in str(error)
        assert good, name
        passed += 1
    record_row("C6", f"{encoding}: read as it is, or named", passed, len(TEXTS))
    assert passed == len(TEXTS)


@pytest.mark.parametrize("part", [";", "\t"])
@pytest.mark.parametrize("form", ["caliscope", "deeplabcut_csv"])
def test_decimal_commas_are_read(part, form, tmp_path, record_row):
    """What a spreadsheet of another country makes of the table."""
    target = hostile.FORMATS[form].write(tmp_path)
    whole = hostile.FORMATS[form].read(tmp_path)
    text = target.read_text().replace(",", "|").replace(".", ",").replace("|", part)
    target.write_text(text)
    assert hostile.same(hostile.FORMATS[form].read(tmp_path), whole)
    record_row("C6", f"{form}, columns parted by {part!r}, decimal commas: as it was", 1, 1)
