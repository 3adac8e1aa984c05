"""Print this package's dependencies at their lower bounds, and the tests' tools, as pip takes them."""

import re
from importlib.metadata import requires

TOOLS = ("pytest", "pytest-timeout", "pytest-xdist", "hypothesis")

for line in requires("arbiview_aug") or ():
    requirement, _, extra = line.partition(";")
    name, bound = re.match(r"([\w.-]+).*?[=>]=([\d.]+)", requirement).groups()
    if not extra or ("dev" in extra and name in TOOLS):
        print(f"{name}=={bound}")
