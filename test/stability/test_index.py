"""Every hard case of docs/numerics.md has a test, and every test its line there."""

import re
from pathlib import Path

HERE = Path(__file__).parent
NUMERICS = HERE.parents[1] / "docs" / "numerics.md"


def test_every_hard_case_is_tested_and_described():
    tested = {
        int(number)
        for file in HERE.glob("test_*.py")
        for number in re.findall(
            r"^@pytest.mark.hard_case\((\d+)\)", file.read_text(), re.MULTILINE
        )
    }
    what, measured = NUMERICS.read_text(encoding="utf-8").split("## Measured")
    described = [int(number) for number in re.findall(r"^\| (\d+) ", what, re.MULTILINE)]
    listed = [int(number) for number in re.findall(r"^\| (\d+) ", measured, re.MULTILINE)]
    assert described == listed == sorted(tested)
