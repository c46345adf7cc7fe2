"""Lists what is shipped in the program: the crates and the parts of the page, with their licences.

    packaging/notices.py --list      one line each: name, version, licence (assets/licences.txt)
    packaging/notices.py             the texts of their licences and notices, each text once

Needs cargo, and the crates' sources: a build has fetched them. Asks no network.
"""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TEXT = re.compile(r"^(licen[sc]e|copying|notice|copyright|unlicense)", re.IGNORECASE)
# The machines for which packages are made.
TARGETS = ("x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu")


def crates() -> dict[str, dict]:
    """The crates that are linked into the program, by identity; not those that only build or test it."""
    linked: dict[str, dict] = {}
    for target in TARGETS:
        command = ["cargo", "metadata", "--locked", "--offline", "--format-version=1", "--features=share"]
        made = subprocess.run([*command, f"--filter-platform={target}"], cwd=ROOT, stdout=subprocess.PIPE, check=True)
        graph = json.loads(made.stdout)
        packages = {package["id"]: package for package in graph["packages"]}
        nodes = {node["id"]: node for node in graph["resolve"]["nodes"]}
        waiting = [graph["resolve"]["root"]]
        while waiting:
            here = waiting.pop()
            if here in linked:
                continue
            linked[here] = packages[here]
            for dependency in nodes[here]["deps"]:
                kinds = {kind["kind"] for kind in dependency["dep_kinds"]}
                macro = all("proc-macro" in target["kind"] for target in packages[dependency["pkg"]]["targets"][:1])
                if None in kinds and not macro:
                    waiting.append(dependency["pkg"])
    return {name: package for name, package in linked.items() if package["source"]}


def parts() -> list[tuple[str, str, str, Path | None]]:
    """Name, version, licence and folder of each part."""
    found = []
    for package in crates().values():
        licence = package["license"] or "see its text"
        folder = Path(package["manifest_path"]).parent
        found.append((package["name"], package["version"], licence.replace("/", " OR "), folder))
    lock = json.loads((ROOT / "viewer/package-lock.json").read_text())
    for place, package in lock["packages"].items():
        if place and not package.get("dev") and not package.get("optional"):
            folder = ROOT / "viewer" / place
            found.append((place.split("node_modules/")[-1], package["version"], package["license"], folder))
    return sorted(found, key=lambda part: (part[0], part[1]))


def main() -> None:
    found = parts()
    if sys.argv[1:] == ["--list"]:
        for name, version, licence, _ in found:
            print(f"{name} {version}: {licence}")
        return
    texts: dict[str, tuple[str, list[str]]] = {}
    print("dimos contains these works of others, under the licences that follow.\n")
    for name, version, licence, folder in found:
        print(f"{name} {version}: {licence}")
        files = sorted(folder.iterdir()) if folder and folder.is_dir() else []
        for file in files:
            if file.is_file() and TEXT.match(file.name):
                text = file.read_text(errors="replace").strip()
                key = hashlib.sha256(" ".join(text.split()).encode()).hexdigest()
                texts.setdefault(key, (text, []))[1].append(f"{name} {version}")
    for text, names in texts.values():
        print(f"\n{'-' * 100}\n{', '.join(names)}\n{'-' * 100}\n\n{text}")


if __name__ == "__main__":
    main()
