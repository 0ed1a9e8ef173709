#!/bin/sh
# Bytes of code and constants of the implementation for each DIST_NO_ switch, at -Os: csv. From the root of the
# repository. A compiler that is not installed, or lacks the C library's headers, is left out with a word on stderr.
#
#   sh bench/code_size.sh [--quick]      quick: x86-64, nothing and all left out

work=$(mktemp -d) || exit 1
trap 'rm -rf "$work"' EXIT
printf '#define DIST_IMPLEMENTATION\n#include "dist.h"\n' >"$work/dist.c"
[ "$1" = --quick ] && quick=1
switches=$(sed -n '/^   Options/,/^$/p' dist.h | grep -o 'DIST_NO_[A-Z_]*' | sort -u)

# bytes COMMAND...: text and data of the object file
bytes() {
    "$@" -std=c99 -Os -w -I. -c "$work/dist.c" -o "$work/dist.o" 2>"$work/why" &&
        size "$work/dist.o" | awk 'NR == 2 { print $1 + $2 }'
}

# table NAME COMMAND...
table() {
    name=$1
    shift
    command -v "$1" >/dev/null 2>&1 || { echo "code_size: $1 is not installed" >&2; return; }
    all=$(bytes "$@")
    [ -n "$all" ] || { echo "code_size: $name: $(head -n 1 "$work/why")" >&2; return; }
    echo "$name,none,$all,0"
    together=
    for switch in $switches; do
        together="$together -D$switch"
        [ -z "$quick" ] || continue
        left=$(bytes "$@" "-D$switch")
        echo "$name,$switch,$left,$((all - left))"
    done
    left=$(bytes "$@" $together)
    echo "$name,all of them,$left,$((all - left))"
}

echo "target,left out,bytes,saved"
table x86-64 "${CC:-cc}"
[ -z "$quick" ] || exit 0
table cortex-m4 arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16
table cortex-m7 arm-none-eabi-gcc -mcpu=cortex-m7 -mthumb -mfloat-abi=hard -mfpu=fpv5-d16
