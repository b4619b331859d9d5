#!/usr/bin/env bash
# Makes viz/templates/three.min.js, the part of three.js (MIT) that reports draw with, and its licence beside it.
# Needs Node.js with npm; only whoever takes a newer three.js runs it.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
out="$here/../../viz/templates"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
cp "$here/package.json" "$here/entry.js" "$work"
cd "$work"
npm install --silent --no-audit --no-fund
version="$(node -p 'JSON.parse(require("fs").readFileSync("node_modules/three/package.json")).version')"
npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=none --charset=ascii \
    --target=es2022 --banner:js="/* three.js $version, MIT licence, see three.LICENSE.txt */" --outfile="$out/three.min.js"
cp node_modules/three/LICENSE "$out/three.LICENSE.txt"
