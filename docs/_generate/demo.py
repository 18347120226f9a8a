"""Builds the page on which a visitor's browser simulates the tasks and runs the trained policies: `make demo`.

The sources are in `docs/demo`. MuJoCo's WebAssembly build and three.js come from npm, in the versions and with the
hashes of `package-lock.json`. The folder that results, `.cache/demo`, is a static site that fetches nothing from
elsewhere.
"""

import filecmp
import gzip
import json
import re
import shutil
import subprocess
from pathlib import Path

from hgail_envs.robots.fetch import PARTS

ROOT = Path(__file__).parent.parent.parent
SOURCES = ROOT / "docs" / "demo"
SITE = ROOT / ".cache" / "demo"
PACKAGES = ROOT / ".cache" / "demo-packages"
ABSENT = ("tower*", "*-other-arms", "*-full-known-delay")
"""Policies that the page does not have: of a task that it does not simulate, and of some levels."""

_LOCK = ("package.json", "package-lock.json")
_PATIENCE = 120.0  # seconds for the packages, 13 MB
_VENDOR = {
    "mujoco.js": "@mujoco/mujoco/mujoco.js",
    "three.module.js": "three/build/three.module.js",
    "three.core.js": "three/build/three.core.js",
    "RoundedBoxGeometry.js": "three/examples/jsm/geometries/RoundedBoxGeometry.js",
    "LICENSE-three": "three/LICENSE",
}
# MuJoCo's bindings make functions of text, which a strict content security policy refuses; these do the same.
_OF_TEXT = {
    "      var invokerFn = new Function(...args, invokerFnBody)(...closureArgs);\n": """\
      var types = argTypes.slice(isClassMethodFunc ? 1 : 2);
      var invokerFn = function (...given) {
        checkArgCount(given.length, minArgs, expectedArgCount, humanName, throwBindingError);
        var destructors = needsDestructorStack ? [] : null, values = isClassMethodFunc ? [this, ...given] : given;
        var wired = types.map((type, index) => type.toWireType(destructors, values[index]));
        var returned = cppInvokerFunc(cppTargetFunc, ...wired);
        if (needsDestructorStack) runDestructors(destructors);
        else types.forEach((type, index) => type.destructorFunction?.(wired[index]));
        if (returns) return argTypes[0].fromWireType(returned);
      };
""",
    "      var invokerFunction = new Function(...params, functionBody)(...args);\n": """\
      var invokerFunction = function (obj, func, destructorsRef, at) {
        var values = types.map((type) => [type.readValueFromPointer(at), (at += type.argPackAdvance)][0]);
        var returned = kind === 1 ? new func(...values) : func.call(...(kind === 0 ? [obj] : []), ...values);
        if (!retType.isVoid) return emval_returnValue(retType, destructorsRef, returned);
      };
""",
}


class UnavailableError(Exception):
    """Node or its packages are not there; says which."""


def build(site: Path = SITE) -> Path:
    """Builds the page in a folder, which is replaced, and returns it.

    Raises:
      UnavailableError: npm is not installed, or cannot get the packages.
    """
    modules = _install()
    shutil.rmtree(site, ignore_errors=True)
    shutil.copytree(SOURCES, site, ignore=shutil.ignore_patterns(*_LOCK, "node_modules"))
    vendor = site / "vendor"
    vendor.mkdir()
    for name, source in _VENDOR.items():
        shutil.copyfile(modules / source, vendor / name)
    # The file that it imports by name, without an import map, which has to be inline: a strict policy refuses that.
    box = (vendor / "RoundedBoxGeometry.js").read_text()
    (vendor / "RoundedBoxGeometry.js").write_text(re.sub(r"""from\s+(['"])three\1""", 'from "./three.module.js"', box))
    glue = (vendor / "mujoco.js").read_text()
    for of_text, same in _OF_TEXT.items():
        glue = glue.replace(of_text, same)
    assert "new Function(" not in glue, "these bindings of MuJoCo have other functions of text"
    (vendor / "mujoco.js").write_text(glue)
    shutil.copyfile(ROOT / "LICENSE", vendor / "LICENSE-mujoco")  # Apache-2.0 too, and its package has no copy
    # Compressed here, since not every host compresses WebAssembly; without a time, so that it is the same each time.
    wasm = (modules / "@mujoco/mujoco/mujoco.wasm").read_bytes()
    (vendor / "mujoco.wasm.gz").write_bytes(gzip.compress(wasm, mtime=0))
    scenes = shutil.copytree(ROOT / "assets" / "scenes", site / "scenes")
    for part, file in PARTS.items():
        shutil.copyfile(ROOT / "assets" / "robots" / file, scenes / part)
    absent = shutil.ignore_patterns(*(f"{name}.npz" for name in ABSENT))
    policies = shutil.copytree(ROOT / "assets" / "policies", site / "policies", ignore=absent)
    content = {
        "scenes": sorted(path.name for path in scenes.iterdir()),
        "policies": sorted(path.stem for path in policies.iterdir()),
    }
    (site / "content.json").write_text(json.dumps(content))
    (site / "package.json").write_text('{"type": "module"}')  # without it older Node.js does not run headless.js
    return site


def _install() -> Path:
    """Installs the locked packages, unless they are there, and returns their folder."""
    modules, npm = PACKAGES / "node_modules", shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        raise UnavailableError("Node.js and npm are not installed")
    done = PACKAGES / "installed.json"
    if modules.is_dir() and done.exists() and filecmp.cmp(done, SOURCES / "package-lock.json", shallow=False):
        return modules
    PACKAGES.mkdir(parents=True, exist_ok=True)
    for name in _LOCK:
        shutil.copyfile(SOURCES / name, PACKAGES / name)
    command = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=1"]
    try:
        subprocess.run(command, cwd=PACKAGES, check=True, capture_output=True, text=True, timeout=_PATIENCE)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        said = error.stderr.decode() if isinstance(error.stderr, bytes) else error.stderr or ""
        lines = [line for line in said.splitlines() if line.startswith("npm error")] or [str(error)]
        raise UnavailableError(f"npm could not install the page's packages: {lines[0]}") from error
    shutil.copyfile(SOURCES / "package-lock.json", done)
    return modules


def main() -> None:
    """Builds the page and prints its folder, or one line that says what is missing."""
    try:
        folder = build()
    except UnavailableError as error:
        raise SystemExit(f"no demo was built: {error}") from error
    print(f"{folder.relative_to(ROOT)} is the page; python -m http.server -d {folder.relative_to(ROOT)} shows it")


if __name__ == "__main__":
    main()
