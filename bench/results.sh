#!/bin/sh
# sh bench/results.sh [--quick] FOLDER PROGRAM...
# Runs the programs that make the paper's tables and figures and puts their sections together in FOLDER/RESULTS.md.
quick=
[ "$1" = --quick ] && quick=--quick && shift
folder=$1
shift
mkdir -p "$folder" || exit 1
DIST_COMMIT=$(git describe --always --dirty 2>/dev/null)
export DIST_COMMIT

for program in "$@"; do
    begin=$(date +%s)
    echo "$program"
    "$program" $quick --out "$folder" || { echo "$program ended with an error"; exit 1; }
    echo "$program took $(($(date +%s) - begin)) s"
done

{
    echo "# RESULTS"
    echo
    echo "Made by \`make results${quick:+-quick}\`; each section names its own command, the machine and the commit."
    echo "Published numbers are of other shapes, decoders and machines."
    # The tracer first, then what is fitted with it.
    first="ladder marching threshold"
    for name in $first; do [ -e "$folder/$name.md" ] && echo && cat "$folder/$name.md"; done
    for file in "$folder"/*.md; do
        name=$(basename "$file" .md)
        case " $first RESULTS " in *" $name "*) continue ;; esac
        echo
        cat "$file"
    done
} >"$folder/RESULTS.tmp" && mv "$folder/RESULTS.tmp" "$folder/RESULTS.md"
echo "$folder/RESULTS.md"
