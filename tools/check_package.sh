#!/usr/bin/env bash
# Builds the source package and, from it, the wheel; looks into them; installs the wheel in a clean environment outside
# of this folder and runs geomocap there.
#   tools/check_package.sh PYTHON          with the whole demo
#   SMALL=1 tools/check_package.sh PYTHON  with six frames of four small cameras instead
set -euo pipefail
python="$(realpath -s "${1:-python3}")"
cd "$(dirname "$0")/.."
tree="$PWD"

rm -rf build dist
"$python" -m build --outdir dist .

wheel="$(ls "$tree"/dist/geomocap-*.whl)"
source="$(ls "$tree"/dist/geomocap-*.tar.gz)"
holds() {  # FILE LIST: each name must be in it
    for name in "${@:2}"; do
        grep -qF "$name" <<<"$list" || { echo "$1: lacks $name" >&2; exit 1; }
    done
}
list="$("$python" -m zipfile --list "$wheel")"
holds "$wheel" geomocap/py.typed geomocap/cli/app.py data_tools/synthesize.py viz/report.py \
    $(cd "$tree" && ls viz/templates/*) licenses/LICENSE
if grep -E '(^| )(tests|tools|examples|docs)/' <<<"$list"; then
    echo "$wheel: holds folders that are no part of the library" >&2
    exit 1
fi
list="$("$python" -m tarfile --list "$source")"
holds "$source" pyproject.toml README.md CHANGELOG.md LICENSE Makefile mkdocs.yml docs/method/index.md docs/demo.jpg \
    examples/scans_to_bodies.py tests/conftest.py tools/system_packages.sh viz/templates/

away="$(mktemp -d)"
trap 'rm -rf "$away"' EXIT
cd "$away"
"$python" -m venv clean
unset PYTHONPATH
clean/bin/pip install -q --no-compile "$wheel"
clean/bin/pip check
version="$("$python" -c 'import sys, tomllib; print(tomllib.load(open(sys.argv[1], "rb"))["project"]["version"])' \
    "$tree/pyproject.toml")"
told="$(clean/bin/geomocap --version)"
[ "$told" = "geomocap $version" ] || { echo "installed: $told, expected version $version" >&2; exit 1; }
clean/bin/python -c '
import sys, geomocap
assert geomocap.__file__.startswith(sys.argv[1]), geomocap.__file__
print("imported from", geomocap.__file__)' "$away"

if [ -n "${SMALL:-}" ]; then
    clean/bin/geomocap synthesize figure capture --cameras 4 --width 160 --height 120 --fps 10 --frames 6
    clean/bin/geomocap run capture demo/run --carving.resolution 64
else
    clean/bin/geomocap demo demo
fi
for file in skeleton.npz motion.bvh motion.glb review/report.html; do
    [ -s "demo/run/$file" ] || { echo "no $file" >&2; exit 1; }
done
echo "$wheel and $source: built, installed and tried"
