#!/bin/sh
# sh bench/readme.sh [--check]
# Writes README.md between <!-- results --> and <!-- end of results -->: bench/readme.txt with the tables of bench/results.
# --check: writes nothing; fails, with the difference, if the README says anything else.
mkdir -p build
awk '
function table(name, wanted,    file, line, count, inside, found) {
    file = "bench/results/" name ".md"
    while ((getline line < file) > 0) {
        if (line ~ /^\|/ && !inside) count++
        inside = line ~ /^\|/
        if (inside && count == wanted) { print line; found = 1 }
    }
    close(file)
    if (!found) { print "README.md: " file " has no table " wanted >"/dev/stderr"; bad = 1 }
}
function section(    line, words, on, file, answer) {
    while ((getline line < "bench/readme.txt") > 0) {
        split(line, words, " ")
        if (words[1] == "@") {
            file = "bench/results/" words[2] ".md"
            on = (getline answer < file) > 0
            close(file)
            if (on) print ""
        } else if (on && words[1] == "{") {
            table(words[2], words[3])
        } else if (on) {
            print line
        }
    }
}
/^<!-- end of results -->$/ { inside = 0 }
!inside { print }
/^<!-- results -->$/ { section(); inside = 1; seen = 1 }
END { exit bad || inside || !seen }' README.md >build/README.new || exit 1
if [ "$1" = --check ]; then diff README.md build/README.new; else cp build/README.new README.md; fi
