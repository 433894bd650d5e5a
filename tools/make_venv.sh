#!/bin/sh
# Make the environment VENV with PYTHON and install WHAT into it: `sh tools/make_venv.sh PYTHON VENV WHAT`.
# Debian's python3 makes no environment unless python3-venv is installed: root gets it installed, others are told.
set -eu
python=$1
venv=$2
what=$3
if ! "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'; then
    echo "podwatch needs Python 3.11 to 3.13; $("$python" --version) was found. Try: make PYTHON=python3.12" >&2
    exit 1
fi
if [ ! -x "$venv/bin/pip" ] && ! "$python" -m venv "$venv" 2>/dev/null; then
    rm -rf "$venv"
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        apt-get update -qq && apt-get install -y -qq python3-venv
        "$python" -m venv "$venv"
    else
        echo "python's venv module is missing. Run: sudo apt-get install python3-venv" >&2
        exit 1
    fi
fi
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -e "$what"
