"""Numbers that readers are not prepared for."""

INT_WORDS = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FFFFFFF // 4, 1 << 24, 0xFFFF)
"""As 32-bit words: counts, indices, sizes."""

FLOAT_WORDS = (float("nan"), float("inf"), float("-inf"), 3e38, -1.0, 0.0, 1e-45, 1e30)
"""As 32 or 64-bit floats."""

NUMBER_TEXTS = (
    b"nan",
    b"NaN",
    b"inf",
    b"-Infinity",
    b"1e308",
    b"-1e308",
    b"1e999",
    b"1e-320",
    b"-1",
    b"0",
    b"-0.0",
    b"1.5",
    b"2147483647",
    b"4294967295",
    b"9223372036854775807",
    b"18446744073709551616",
    b"1000000000000",
    b"1" + b"0" * 400,
    b"9" * 5000,
    b"0x10",
    b"1_000",
    b"true",
    b"\xd9\xa3",
    b"",
)
"""As text: in JSON, PLY, OBJ and tables of numbers."""
