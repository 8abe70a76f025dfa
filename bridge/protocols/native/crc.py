"""CRC-8 SAE J1850, the last byte of the native frames.  Pure."""


def _crc_table() -> bytes:
    table = bytearray()
    for byte in range(256):
        remainder = byte
        for _ in range(8):
            remainder = (remainder << 1) ^ (0x11D if remainder & 0x80 else 0)
        table.append(remainder)
    return bytes(table)


_CRC = _crc_table()


def crc8(data: bytes, start: int = 0xFF) -> int:
    """Returns CRC-8 SAE J1850 of `data`: polynomial 0x1D, start 0xFF, inverted at the end.

    To continue after earlier data, pass their CRC, inverted, as `start`."""
    crc, table = start, _CRC
    for byte in data:
        crc = table[crc ^ byte]
    return crc ^ 0xFF
