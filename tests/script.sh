# Read by the script tests with ". tests/script.sh". They run from the root of the repository and print one line for each
# test: "ok NAME", "not ok NAME: why" (the first lines of the compiler's answer) or "skip NAME: why".

CC=${CC:-cc}
CXX=${CXX:-c++}
work=build/script/$(basename "$0" .sh)
rm -rf "$work"
mkdir -p "$work"
LC_ALL=C
export LC_ALL

warnings="-Wall -Wextra -Wpedantic -Wconversion -Wsign-conversion -Wshadow -Wcast-qual -Wundef -Wdouble-promotion -Werror"

ok() { echo "ok $1"; }
not_ok() { echo "not ok $1: $2"; }
skip() { echo "skip $1: $2"; }

have() { command -v "$1" >/dev/null 2>&1; }

# expect NAME COMMAND...: ok if the command succeeds.
expect() {
    expect_name=$1
    shift
    if "$@" >"$work/answer" 2>&1; then
        ok "$expect_name"
    else
        not_ok "$expect_name" "it ended with an error, which begins:"
        { grep -e error -e warning -e undefined "$work/answer" || cat "$work/answer"; } | head -n 4 | sed 's/^/    /'
        return 1
    fi
}

# expect_nothing NAME FILE: ok if the file is empty; else its first lines are the reason.
expect_nothing() {
    if [ -s "$2" ]; then
        not_ok "$1" "$(wc -l <"$2" | tr -d ' ') found"
        sed 's/^/    /' "$2" | head -n 8
        return 1
    fi
    ok "$1"
}

# The compilers for C that are installed, one name for each; their C++ is cxx_of.
compilers() {
    for c in gcc clang; do
        have "$c" && echo "$c"
    done
    have gcc || have clang || echo "$CC"
}
cxx_of() {
    case $1 in
    gcc) echo g++ ;;
    clang) echo clang++ ;;
    *) echo "$CXX" ;;
    esac
}

# code FILE: the file with comments and the insides of strings and character constants blanked, line for line.
code() {
    awk '{
        out = ""
        n = length($0)
        for (i = 1; i <= n; i++) {
            c = substr($0, i, 1)
            two = substr($0, i, 2)
            if (comment) {
                if (two == "*/") { comment = 0; i++ }
                out = out " "
            } else if (quote != "") {
                if (c == "\\") i++
                else if (c == quote) { quote = ""; out = out c }
            } else if (two == "/*") { comment = 1; i++; out = out " " }
            else if (two == "//") break
            else {
                if (c == "\"" || c == "\047") quote = c
                out = out c
            }
        }
        quote = ""
        print out
    }' "$1"
}

# sections: "LINE NUMBER NAME" of every marker of the implementation.
sections() {
    sed -n '=; s/^\/\*@ \([0-9][0-9]\) \(.*[^ -]\) -*-* \*\/$/@ \1 \2/p' dist.h |
        awk '/^@/ { print line, $2, substr($0, 6); next } { line = $0 }'
}
