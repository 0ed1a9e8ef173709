#!/bin/sh
# sh bench/readme.sh [--check]
# Puts tables of bench/results into README.md, where it says
#     <!-- table NAME N -->       the Nth table of bench/results/NAME.md, up to
#     <!-- end -->
# --check: writes nothing; fails, with the difference, if the README says anything else.
out=README.tmp
[ "$1" = --check ] && out=build/README.check && mkdir -p build
awk '
/^<!-- table / {
    print
    file = "bench/results/" $3 ".md"
    wanted = $4
    table = inside = found = 0
    while ((getline line < file) > 0) {
        if (line ~ /^\|/ && !inside) table++
        inside = line ~ /^\|/
        if (inside && table == wanted) { print line; found = 1 }
    }
    close(file)
    if (!found) { print "README.md: " file " has no table " wanted > "/dev/stderr"; bad = 1 }
    skip = 1
    next
}
/^<!-- end -->/ { skip = 0 }
!skip { print }
END { exit bad || skip }' README.md >"$out" || { rm -f "$out"; exit 1; }
if [ "$1" = --check ]; then diff README.md "$out"; else mv "$out" README.md; fi
