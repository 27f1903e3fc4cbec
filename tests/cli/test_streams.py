"""Standard streams that are closed or full, `--quiet`, and `--json`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from compgs.cli.console import say
from compgs.cli.main import main
from compgs.codec.reader import file_info

GOLDEN_FILE = Path(__file__).parent.parent / "golden" / "tiny.cgs"
LINUX = sys.platform == "linux"


def by_the_shell(redirection: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """`compgs ARGUMENTS REDIRECTION`."""
    line = f'exec "$0" -m compgs "$@" {redirection}'
    return subprocess.run(
        ["sh", "-c", line, sys.executable, *map(str, arguments)], capture_output=True, text=True, check=False
    )


CLOSED = (">&-", "2>&-", "<&-", ">&- 2>&- <&-")


@pytest.mark.parametrize(
    ("arguments", "redirection"),
    [
        *((["--help"], redirection) for redirection in CLOSED),
        (["info", GOLDEN_FILE], CLOSED[-1]),
        *(
            pytest.param(["info", GOLDEN_FILE], redirection, marks=pytest.mark.slow)
            for redirection in CLOSED[:-1]
        ),
        *(
            pytest.param(arguments, redirection, marks=pytest.mark.slow)
            for arguments in (["info", "--help"], ["--version"])
            for redirection in CLOSED
        ),
    ],
)
def test_a_closed_stream_is_no_error(redirection: str, arguments: list[object]) -> None:
    done = by_the_shell(redirection, *arguments)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("redirection", CLOSED[:3])
def test_what_is_wrong_keeps_its_exit_code_where_a_stream_is_closed(redirection: str) -> None:
    done = by_the_shell(redirection, "info", "nowhere.cgs")
    assert done.returncode == 1
    assert done.stderr == ("" if redirection == "2>&-" else "error: nowhere.cgs: there is no such file\n")


def test_a_file_that_is_opened_does_not_take_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """Else what is said would be written into it."""
    done = by_the_shell(">&- 2>&-", "decode", GOLDEN_FILE, "-o", tmp_path / "arrays")
    assert done.returncode == 0
    for file in (tmp_path / "arrays").iterdir():
        assert b"arrays" not in file.read_bytes()[:200] or file.suffix == ".json"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize("arguments", [["info", GOLDEN_FILE], ["--help"], ["--version"]])
def test_a_full_disk_behind_standard_output_is_said(arguments: list[object]) -> None:
    done = by_the_shell("> /dev/full", *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ") and "No space left" in done.stderr
    assert done.stderr.count("\n") == 1


def test_quiet_says_nothing_but_what_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(GOLDEN_FILE), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert main(["info", "nowhere.cgs", "-q"]) == 1
    assert capsys.readouterr() == ("", "error: nowhere.cgs: there is no such file\n")
    assert main(["info", str(GOLDEN_FILE)]) == 0
    assert capsys.readouterr().out.startswith(str(GOLDEN_FILE))


def test_a_quiet_command_leaves_others_as_loud_as_they_were(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(GOLDEN_FILE), "--quiet"]) == 0
    say("heard")
    assert capsys.readouterr().out == "heard\n"


def test_info_as_json_has_the_files_bytes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(GOLDEN_FILE), "--json"]) == 0
    out, err = capsys.readouterr()
    facts = json.loads(out)
    assert err == ""
    assert facts["bytes"] == GOLDEN_FILE.stat().st_size == sum(facts["components"].values())
    assert facts["anchors"] == file_info(GOLDEN_FILE.read_bytes()).anchors
    assert facts["prefixes"][-1]["anchors"] == facts["anchors"]


def test_compare_as_json_is_what_results_json_has_and_standard_output_has_nothing_else(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = str(GOLDEN_FILE)
    assert main(["compare", file, file, "--json", "-o", str(tmp_path / "comparison")]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    views = found.pop("per_view")
    assert found == json.loads((tmp_path / "comparison" / "results.json").read_text())
    assert views == json.loads((tmp_path / "comparison" / "per_view.json").read_text())
    assert "comparison.html" in err
