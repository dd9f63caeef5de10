"""The checksum seeds are those of pymavlink's dialect."""

from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.wire.crc_extra import CRC_EXTRA, LONGEST


def as_source(table: dict[int, int], width: int = 100) -> str:
    """Return the table as written in ``messages.py``."""
    lines, line = ["CRC_EXTRA: dict[int, int] = {"], "   "
    for msgid, seed in sorted(table.items()):
        entry = f" {msgid}: {seed},"
        if len(line + entry) > width:
            lines.append(line)
            line = "   "
        line += entry
    return "\n".join([*lines, line, "}"])


def test_crc_extra_matches_the_dialect() -> None:
    expected = {msgid: kind.crc_extra for msgid, kind in dialect.mavlink_map.items()}
    assert expected == CRC_EXTRA, f"\nthe dialect has another table:\n\n{as_source(expected)}\n"


def test_printed_table_is_valid_source() -> None:
    text = as_source(CRC_EXTRA)
    scope: dict[str, object] = {}
    exec(text, scope)
    assert scope["CRC_EXTRA"] == CRC_EXTRA
    assert max(map(len, text.splitlines())) <= 100


def test_longest_payloads_match_the_dialect() -> None:
    kinds = dialect.mavlink_map
    expected = bytes(kinds[i].unpacker.size if i in kinds else 255 for i in range(256))
    assert expected == LONGEST, f"\nthe dialect has another table:\n\n{expected.hex()}\n"
