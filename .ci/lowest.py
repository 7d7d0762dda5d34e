"""The lowest versions that pyproject.toml allows of what it names: constraints for pip, one a line."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
for requirement in [*project["dependencies"], *project["optional-dependencies"]["test"]]:
    name, lowest = re.match(r"([\w-]+)[^>]*>=([\w.]+)", requirement).groups()
    print(f"{name}=={lowest}")
