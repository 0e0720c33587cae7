"""The tutorials for simulation: their commands run as they stand there, with smaller numbers."""

import pytest
from support.pages import commands_of, run_page

PAGE = """
```bash
make install && export A=b   # set up
lerobot-x --steps=1250 --env.task=T \\
  --robot.cameras='{gripper: {type: microphone,
    device: "USB Audio"}}' --robot.port=/dev/ttyACM0
```
Not this: `rm -rf x`.
- And, in a list,

  ```bash
  lerobot-y --steps=3
  ```
"""


def test_a_pages_commands_are_read_and_made_small(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    camera = '--robot.cameras={gripper: {type: microphone,\n    device: "USB Audio"}}'
    first = ["lerobot-x", "--steps=2", "--env.task=T"]
    assert commands_of(page, {"--steps": 2}) == [
        ["make", "install"],
        ["export", "A=b"],
        [*first, camera, "--robot.port=/dev/ttyACM0"],
        ["lerobot-y", "--steps=2"],
    ]
    assert commands_of(page, {"--steps": 2, "--robot.*": ["--robot.type=sim"]})[2] == [*first, "--robot.type=sim"]
    with pytest.raises(AssertionError, match=r"nothing in page\.md has --batch_size"):
        commands_of(page, {"--batch_size": 2})
    with pytest.raises(ValueError, match="T"):
        commands_of(page, {"--env.task": 2})  # other numbers, not other tasks
    ran = run_page(lambda *words, environment: (words, environment), page, own={"make": lambda *words: words})
    assert ran[0] == ("install",)
    assert ran[2] == (("lerobot-y", "--steps=3"), {"A": "b"})
