"""`compgs compare`: what is said is what was found, and mistakes are caught before anything is computed."""

import json
from pathlib import Path

import pytest

from compgs.cli.main import main
from compgs.exporting import export
from compgs.scene.generated import generate_scene


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_two_files_and_photographs_in_numbers(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, tiny_cgs: Path
) -> None:
    splats, scene, out = tmp_path / "a.ply", tmp_path / "scene", tmp_path / "out"
    export(tiny_cgs, splats, degree=0, refine=0)
    generate_scene(scene, views=9, width=32, height=24)
    code, said, err = outcome(capsys, "compare", tiny_cgs, splats, "--scene", scene, "-o", out)
    assert (code, err) == (0, "")
    found = json.loads((out / "results.json").read_text())
    assert f"{found['a']['bytes']:,}" in said and f"{found['b']['bytes']:,}" in said
    change = 100 * (found["b"]["bytes"] / found["a"]["bytes"] - 1)
    assert f"{change:+.1f} %" in said
    for side in ("a", "b"):
        assert f"{found[side]['psnr']:.2f} dB" in said and f"{found[side]['ssim']:.4f}" in said
    assert f"{found['b']['psnr'] - found['a']['psnr']:+.2f} dB" in said
    assert f"a.ply against tiny.cgs: PSNR {found['psnr']:.2f} dB" in said
    assert "held-out views of scene (32 x 24 pixels)" in said
    assert f"They differ most in {found['worst_view']}" in said
    assert str(out / "comparison.html") in said


def test_without_a_folder_nothing_is_written(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, tiny_cgs: Path
) -> None:
    code, said, _ = outcome(capsys, "compare", tiny_cgs, tiny_cgs)
    assert code == 0 and "Their pictures are identical" in said and "photographs" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["tiny.cgs"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nowhere.cgs", "FILE"], 1, "nowhere.cgs: there is no such file"),
        (["FILE", "nowhere.cgs"], 1, "nowhere.cgs: there is no such file"),
        (["FILE"], 2, "compgs compare --help"),
        (["FILE", "FILE", "--scene", "a", "--cameras", "b"], 2, "--scene and --cameras were both given"),
        (["FILE", "FILE", "--scene", "nowhere"], 1, "nowhere: does not exist"),
        (["FILE", "FILE", "--cameras", "nowhere.json"], 1, "nowhere.json: cannot be read"),
        (["FILE", "FILE", "-r", "0"], 2, "--downscale 0: expected a whole number"),
        (["FILE", "FILE", "-o", "full"], 1, "--overwrite"),
    ],
)
def test_mistakes_are_one_clear_line_and_nothing_is_written(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    tiny_cgs: Path,
    arguments: list[str],
    code: int,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("full").mkdir()
    Path("full", "precious").touch()
    named = [str(tiny_cgs) if a == "FILE" else a for a in arguments]
    found, _, err = outcome(capsys, "compare", *named)
    assert found == code
    assert err.startswith("error: ") and words in err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["full", "precious", "tiny.cgs"]
