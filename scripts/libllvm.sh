#!/bin/sh
# Mitsuba compiles its kernels with libLLVM: use the one that is there, or install Debian's.
set -eu
python="$1"
have() { "$python" -c 'import sys; from deepshade.llvm import find_libllvm; sys.exit(find_libllvm() is None)'; }
have && exit 0
line="apt-get install -y libllvm19"
if [ "$(id -u)" = 0 ]; then as_root=""; elif sudo -n true 2>/dev/null; then as_root="sudo -n"; else as_root=none; fi
if [ "$as_root" != none ] && command -v apt-get >/dev/null 2>&1; then
    echo "installing libllvm19"
    $as_root apt-get update -qq || true
    $as_root env DEBIAN_FRONTEND=noninteractive $line -qq >/dev/null || true
fi
have && exit 0
echo "Rendering needs libLLVM 17 or newer, and none was found. Install it with:" >&2
echo "    sudo $line" >&2
exit 1
