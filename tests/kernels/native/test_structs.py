"""Fields of XLA's structs against a C compiler, and headers that have them elsewhere."""

import re
import shutil
import subprocess
from pathlib import Path

import jax
import pytest

from r3jax.kernels.native.structs import OFFSETS, misread, misread_in

HEADER = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"


@pytest.fixture(scope="module")
def header():
    return HEADER.read_text(encoding="utf-8")


def test_handlers_read_the_structs_of_this_jaxlib():
    assert misread() == ""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler here")
def test_offsets_are_those_of_a_compiler(tmp_path):
    places = "".join(
        f'  printf("%zu ", offsetof(XLA_FFI_{struct}, {field}));\n'
        for struct, field in (path.split(".", 1) for path in OFFSETS)
    )
    source = tmp_path / "offsets.c"
    source.write_text(
        f'#include <stddef.h>\n#include <stdio.h>\n#include "{HEADER}"\n'
        f"int main(void) {{\n{places}  return 0;\n}}\n"
    )
    subprocess.run(["cc", source, "-o", tmp_path / "offsets"], check=True)
    found = subprocess.run([tmp_path / "offsets"], check=True, capture_output=True, text=True)
    assert [int(word) for word in found.stdout.split()] == list(OFFSETS.values())


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("  XLA_FFI_DataType dtype;\n  void* data;", "  void* data;", "Buffer.data.*16"),
        ("  int64_t* dims;", "  size_t* dims;", ""),
        ("  int64_t* dims;", "  int64_t more;\n  int64_t* dims;", "Buffer.dims.*48"),
        ("  int64_t* dims;", "  size_t* dims;\n  int64_t more;", ""),
        # A struct that lies in another moves what follows it, even where it grows at its end.
        ("  void** args;", "  void** args;\n  void* more;", "CallFrame.rets.rets.*120"),
        ("  XLA_FFI_Args args;", "  XLA_FFI_Arguments args;", "args.args"),
        ("struct XLA_FFI_Buffer {", "struct XLA_FFI_Tensor {", "Buffer.data"),
        ("#define XLA_FFI_API_MAJOR 0", "#define XLA_FFI_API_MAJOR 1", "MAJOR is not 0"),
        ("XLA_FFI_Extension_Metadata = 1", "XLA_FFI_Extension_Metadata = 12", "is not 1"),
        ("#define XLA_FFI_API_MINOR ", "#define XLA_FFI_API_MINOR 9", ""),
    ],
)
def test_a_header_that_changed_is_read_only_where_no_field_moved(header, before, after, said):
    assert header.count(before) == 1
    found = misread_in(header.replace(before, after))
    assert re.search(said, found) if said else found == ""


def test_no_header_is_a_problem():
    assert misread_in("") != ""


def test_comments_hold_no_fields(header):
    commented = re.sub(r"(void\* data;)", r"// void* data;\n  /* int x; */ \1", header)
    assert commented != header
    assert misread_in(commented) == ""
