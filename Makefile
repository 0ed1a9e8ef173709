# dist.h needs no build. This makes the examples, the benchmarks and the tests; a C compiler and make are enough.
#
#   make                every examples/*.c and bench/*.c as build/NAME
#   make demo           the demonstration: fits a shape to one depth picture, results in out/
#   make test           all tests, in a few minutes; the last line is the sum
#   make torture        the table of hard cases in every instruction set, and 20,000 random scenes: about five minutes
#   make matrix         the tests under every compiler, option and instruction set that this machine has
#   make matrix-quick   the part of it that every change must pass
#   make bench          the benchmarks in short, under ten minutes; CSV and plots also go to bench/results;
#                       build/bench_NAME --help tells what else they do
#   make results        the paper's tables and figures with ours beside them, into bench/results/: one to two hours on
#                       two cores that have nothing else to do
#                       (HAVE=FILE.csv: rows of error against cost that need not be made again)
#   make results-quick  the same in small, into build/results/: a minute or two
#   make clean

CC = cc
CXX = c++
CFLAGS = -O2
DEMO_COMMAND = build/fit_depth --demo --out out/demo
BENCH_COMMAND = CC="$(CC)" CFLAGS="$(CFLAGS)" sh bench/run.sh

STRICT = -std=c99 -Wall -Wextra -Wpedantic -Wconversion -Wsign-conversion -Wshadow -Wcast-qual -Wundef \
         -Wdouble-promotion -Wmissing-prototypes -Werror
# Where and how test programs are built; the matrix sets both.
TEST_DIR = build
TEST_FLAGS = $(STRICT)

PROGRAMS = $(patsubst examples/%.c,build/%,$(wildcard examples/*.c))
BENCHES = $(patsubst bench/%.c,build/%,$(wildcard bench/*.c))
RESULTS = $(filter build/results_%,$(BENCHES))
TESTS = $(patsubst tests/%.c,$(TEST_DIR)/%,$(wildcard tests/test_*.c))

# Programs use all cores where the compiler can; the tests do not, so that the plain path is what is tested.
OPENMP = $(eval OPENMP := $(shell mkdir -p build && echo 'int main(void) { return 0; }' > build/probe.c && \
         $(CC) -fopenmp build/probe.c -o build/probe 2>/dev/null && echo -fopenmp))$(OPENMP)
# Pictures are written as PNG where stb_image_write.h is found, else as PPM.
STB = -isystem build/stb/usr/include

# Libraries to compare with and to hook in, each where it is installed: $(call installed,flags of a program that needs it)
installed = $(shell mkdir -p build && echo 'int main(void) { return 0; }' > build/probe.c && \
            echo '\#include <$(1)>' | $(CC) -E - >/dev/null 2>&1 && $(CC) build/probe.c $(3) -o build/probe 2>/dev/null && \
            echo $(2) $(3))
CBLAS = $(call installed,cblas.h,-DWITH_CBLAS,-lopenblas)
DNNL = $(call installed,dnnl.h,-DWITH_DNNL,-ldnnl)

all: $(PROGRAMS) $(BENCHES)

# Programs are linked with one translation of the library, which takes fifteen seconds: the one that each of them asks
# for, so that it compiles alone as well, is kept out by DIST_IMPLEMENTED. Those that look inside or leave something out
# hold their own.
LIBRARY = build/dist.o
HEADERS = dist.h $(wildcard examples/*.h bench/*.h)
COMPILE = $(CC) $(CFLAGS) $(STRICT) $(OPENMP) $(STB)
OWN = $(addprefix build/bench_,grow net step work_precision)

$(LIBRARY): dist.h
	@mkdir -p build
	$(CC) $(CFLAGS) $(STRICT) $(OPENMP) -DDIST_IMPLEMENTATION -x c -c $< -o $@

build/bench_blas: bench/bench_blas.c $(HEADERS)
	$(COMPILE) $< -o $@ $(CBLAS) $(DNNL) -lm

$(OWN): build/%: bench/%.c $(HEADERS) | build/stb/done
	$(COMPILE) $< -o $@ -lm

build/arena: examples/arena.c $(HEADERS) | build/stb/done
	$(COMPILE) $< -o $@ -lm

build/blas: examples/blas.c $(LIBRARY) $(HEADERS)
	$(COMPILE) -DDIST_IMPLEMENTED $< $(LIBRARY) -o $@ $(CBLAS) -lm

build/scheduler: examples/scheduler.c $(LIBRARY) $(HEADERS)
	$(COMPILE) -DDIST_IMPLEMENTED -pthread $< $(LIBRARY) -o $@ -lm

build/results_photos: examples/fit_photos.c
build/results_pose: examples/fit_pose.c

build/%: examples/%.c $(LIBRARY) $(HEADERS) | build/stb/done
	$(COMPILE) -DDIST_IMPLEMENTED $< $(LIBRARY) -o $@ -lm

build/%: bench/%.c $(LIBRARY) $(HEADERS) | build/stb/done
	$(COMPILE) -DDIST_IMPLEMENTED $< $(LIBRARY) -o $@ -lm

# Tests are linked with one translation of the library, which takes fifteen seconds; those of its inside hold it themselves.
$(TEST_DIR)/test_%: tests/test_%.c $(TEST_DIR)/inside.o $(wildcard tests/*.h examples/*.h bench/*.h)
	$(CC) $(CFLAGS) $(TEST_FLAGS) $< $(TEST_DIR)/inside.o -o $@ -lm

INSIDE = $(addprefix $(TEST_DIR)/test_,inside needs)
$(INSIDE): $(TEST_DIR)/test_%: tests/test_%.c dist.h $(wildcard tests/*.h)
	@mkdir -p $(TEST_DIR)
	$(CC) $(CFLAGS) $(TEST_FLAGS) $< -o $@ -lm

$(TEST_DIR)/inside.o: tests/inside.c tests/inside.h dist.h
	@mkdir -p $(TEST_DIR)
	$(CC) $(CFLAGS) $(TEST_FLAGS) -c $< -o $@

# Fetches Debian's package of the stb headers, without root and only if they are missing; a failure does no harm.
build/stb/done:
	@mkdir -p build/stb
	@echo '#include <stb/stb_image_write.h>' | $(CC) -E - >/dev/null 2>&1 || (cd build/stb && \
	 timeout 60 apt-get -o Acquire::Retries=0 download libstb-dev && dpkg-deb -x libstb-dev_*.deb .) >/dev/null 2>&1 || true
	@touch $@

demo: build/fit_depth
	@mkdir -p out
	$(DEMO_COMMAND)

bench: $(filter-out $(RESULTS),$(BENCHES))
	@$(BENCH_COMMAND)

results: $(RESULTS) build/bench_needs build/bench_step build/bench_work_precision
	@sh bench/results.sh bench/results $(RESULTS)
	@sh bench/readme.sh

results-quick: $(RESULTS) build/bench_needs build/bench_step build/bench_work_precision
	@sh bench/results.sh --quick build/results $(RESULTS)

test-programs: $(TESTS)

# Two at a time, whatever -j says; a program that does not build is counted as failed by the runner.
test:
	@mkdir -p build
	@$(MAKE) -s -k -j2 --no-print-directory test-programs || true
	@CC="$(CC)" CXX="$(CXX)" sh tests/run.sh -s

# csv: row, case, expected, got; each program ends with its sum. Instruction sets that the processor lacks are skipped.
torture: $(TEST_DIR)/test_stability $(TEST_DIR)/test_torture
	@for isa in scalar sse2 avx2 avx512 neon; do echo "instruction set $$isa"; \
	 DIST_TORTURE=1 DIST_TEST_ISA=$$isa $(TEST_DIR)/test_stability || exit 1; \
	 DIST_TORTURE=200 DIST_TEST_ISA=$$isa $(TEST_DIR)/test_torture || exit 1; done
	@DIST_TORTURE=20000 $(TEST_DIR)/test_torture

matrix:
	@sh tests/matrix.sh

matrix-quick:
	@sh tests/matrix.sh quick

clean:
	rm -rf build

.PHONY: all demo test test-programs torture matrix matrix-quick bench results results-quick clean
