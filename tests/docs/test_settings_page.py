"""docs/settings.md says what config.py says."""

import importlib.util
from pathlib import Path

from compgs.config import Config, load_config

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_what_the_tool_makes_of_the_settings() -> None:
    spec = importlib.util.spec_from_file_location("settings_page", ROOT / "tools" / "settings_page.py")
    assert spec is not None and spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert page == tool.page(), "run tools/settings_page.py"
    for section, values in Config().to_dict().items():
        for name in values:
            assert f"| `{name}` |" in page, f"{section}.{name}"
    assert f"; `paper`: {load_config('paper').model.coupled_primitives} |" in page
