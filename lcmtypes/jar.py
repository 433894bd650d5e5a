"""Our message types as Java classes in lcmtypes_podwatch.jar, for lcm-spy: `python -m lcmtypes.jar`.

The wheel is built with it where a JDK is present. Installed without one, this command adds it later.
"""

import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import lcm

__all__ = ["JAR", "JAVA_FOLDER", "JarError", "build_jar"]

FOLDER = Path(__file__).parent
JAR = FOLDER / "podwatch" / "lcmtypes_podwatch.jar"
PREFIX = Path(lcm.__file__).parent.parent  # where lcm's wheel puts bin/ and share/
JAVA_FOLDER = PREFIX / "share" / "java"  # lcm.jar and what lcm-spy draws with
RELEASE = "8"  # Java of the oldest machine that may read the classes; lcm-spy's own class reader needs it too
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # in the jar, so that the same types give the same bytes


class JarError(Exception):
    """The jar cannot be built here; the message says what is missing and what to do."""


def build_jar(folder: Path = FOLDER, jar: Path | None = None) -> Path:
    """Write the jar of `folder`'s .lcm files, one class a struct. Raises JarError."""
    jar = jar or folder / "podwatch" / JAR.name
    compiler, library = shutil.which("javac"), JAVA_FOLDER / "lcm.jar"
    if compiler is None:
        raise JarError("there is no Java compiler; sudo apt-get install default-jdk-headless")
    if not library.is_file():
        raise JarError(f"{library} is not there; pip install --force-reinstall lcm==1.5.3")
    types = sorted(str(path) for path in folder.glob("*.lcm"))
    with tempfile.TemporaryDirectory() as made:
        sources, classes = Path(made, "java"), Path(made, "classes")
        _run(str(PREFIX / "bin" / "lcm-gen"), "--java", "--jpath", str(sources), *types)
        files = sorted(str(path) for path in sources.rglob("*.java"))
        options = ("-nowarn", "-Xlint:-options", "--release", RELEASE, "-cp", str(library))
        _run(compiler, *options, "-d", str(classes), *files)
        with zipfile.ZipFile(jar, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(classes.rglob("*.class")):
                name = zipfile.ZipInfo(path.relative_to(classes).as_posix(), LONG_AGO)
                archive.writestr(name, path.read_bytes(), zipfile.ZIP_DEFLATED)
    return jar


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise JarError(f"{Path(words[0]).name} failed: {(done.stderr or done.stdout).strip()[-1000:]}")


if __name__ == "__main__":
    try:
        sys.stdout.write(f"{build_jar()}\n")
    except JarError as error:
        sys.exit(f"lcmtypes.jar: {error}")
