/* SPDX-License-Identifier: MIT-0
   test.h - what every test program of dist.h needs

       #include "test.h"

       TEST(depth_of_sphere_is_exact_to_epsilon)
       {
           dist_context *ctx = test_context();
           CHECK_STATUS(DIST_OK, dist_render(ctx, ...), ctx);
           CHECK_NEAR(1.0, depth, 1e-6);
           dist_context_destroy(ctx);
       }

       int main(int argc, char **argv)
       {
           test_begin(argc, argv);
           RUN(depth_of_sphere_is_exact_to_epsilon);
           return test_report();
       }

   A test counts once, however many checks it makes: passed, failed or skipped. A failed check does not end its test;
   REQUIRE does, and so does SKIP("why"), which makes it count as skipped unless a check had failed.
   Arguments: NAME runs only the tests whose name contains it; -v prints each test with its seconds.
   Environment: DIST_TEST_ISA=scalar|sse2|avx2|avx512|neon forces the instruction set of test_context_desc,
   DIST_TEST_QUICK=1 asks for smaller cases (test_quick), DIST_DATA is the folder of test data, DIST_TMP one for what
   tests write.
   Tests run from the root of the repository. */
#ifndef DIST_TEST_H
#define DIST_TEST_H

/* TEST_INSIDE: this program has in itself what it uses of the implementation; the others are linked with inside.c. */
#ifdef TEST_INSIDE
#define DIST_IMPLEMENTATION
#define DIST_STATIC
#endif
#include "../dist.h"
#include "inside.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* The larger number, like fmax, on whose loops gcc 12 fails for aarch64 with an internal error. */
static inline double test_fmax(double a, double b) { return a > b || b != b ? a : b; }
#define fmax test_fmax

#if defined(__GNUC__) || defined(__clang__)
#define TEST_UNUSED __attribute__((unused))
#else
#define TEST_UNUSED
#endif

/* ---- running and counting ---------------------------------------------------------------------------------------- */

enum { TEST_FAILURES_SHOWN = 10 };

typedef struct test_counts {
    const char *program;
    const char *filter;  /* NULL: all */
    const char *current; /* the test that is running */
    int verbose;
    int nothing_runs; /* the instruction set asked for is not in this processor */
    int matched, passed, failed, skipped;
    int checks_failed; /* of the test that is running */
    int skip_asked;
} test_counts;

static test_counts test_state;

/* Notes a failed check and tells whether it should still be printed. */
TEST_UNUSED static int test_fail(const char *file, int line)
{
    test_state.checks_failed++;
    if (test_state.checks_failed == TEST_FAILURES_SHOWN + 1) printf("    (more failed checks are not shown)\n");
    if (test_state.checks_failed > TEST_FAILURES_SHOWN) return 0;
    printf("    %s:%d: %s: ", file, line, test_state.current ? test_state.current : "(outside a test)");
    return 1;
}

TEST_UNUSED static void test_run(const char *name, void (*test_fn)(void))
{
    if (test_state.nothing_runs) return;
    if (test_state.filter && !strstr(name, test_state.filter)) return;
    clock_t begin = clock();
    test_state.matched++;
    test_state.current = name;
    test_state.checks_failed = 0;
    test_state.skip_asked = 0;
    test_fn();
    if (test_state.checks_failed) {
        test_state.failed++;
        printf("not ok %s: %d failed check%s\n", name, test_state.checks_failed,
               test_state.checks_failed == 1 ? "" : "s");
    } else if (test_state.skip_asked) {
        test_state.skipped++;
    } else {
        test_state.passed++;
        if (test_state.verbose) printf("ok %s (%.2f s)\n", name, (double)(clock() - begin) / (double)CLOCKS_PER_SEC);
    }
    test_state.current = NULL;
    fflush(stdout);
}

TEST_UNUSED static void test_skip(const char *reason)
{
    test_state.skip_asked = 1;
    printf("skip %s: %s\n", test_state.current ? test_state.current : test_state.program, reason);
}

/* Prints the sum as the last line; main returns it. To have run nothing, by a filter that fits none, is a failure. */
TEST_UNUSED static int test_report(void)
{
    if (test_state.matched == 0 && !test_state.nothing_runs) {
        test_state.failed++;
        printf("not ok %s: no test matches\n", test_state.filter ? test_state.filter : test_state.program);
    }
    printf("%d passed, %d failed, %d skipped\n", test_state.passed, test_state.failed, test_state.skipped);
    return test_state.failed != 0;
}

#define TEST(name) static void test_case_##name(void)
#define RUN(name) test_run(#name, test_case_##name)

#define SKIP(reason)       \
    do {                   \
        test_skip(reason); \
        return;            \
    } while (0)

/* ---- checks ------------------------------------------------------------------------------------------------------ */

/* By the bits, since -ffast-math removes tests of the value. */
TEST_UNUSED static int test_finite(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return (bits & 0x7ff0000000000000u) != 0x7ff0000000000000u;
}

TEST_UNUSED static int test_finite_all(size_t n, const float *x)
{
    for (size_t i = 0; i < n; i++)
        if (!test_finite((double)x[i])) return 0;
    return 1;
}

TEST_UNUSED static int test_check(int good, const char *what, const char *file, int line)
{
    if (!good && test_fail(file, line)) printf("not so: %s\n", what);
    return good;
}

/* Numbers that are not finite are near each other only if they are the same bits. */
TEST_UNUSED static int test_is_near(double expected, double got, double tolerance)
{
    if (!test_finite(expected) || !test_finite(got)) return memcmp(&expected, &got, sizeof got) == 0;
    return fabs(expected - got) <= tolerance;
}

TEST_UNUSED static int test_near(double expected, double got, double tolerance, const char *what, const char *file,
                                 int line)
{
    int good = test_is_near(expected, got, tolerance);
    if (!good && test_fail(file, line))
        printf("%s: expected %.9g, got %.9g, tolerance %.3g\n", what, expected, got, tolerance);
    return good;
}

TEST_UNUSED static int test_near_array(size_t n, const float *expected, const float *got, double tolerance,
                                       const char *what, const char *file, int line)
{
    size_t wrong = 0, worst = 0;
    double worst_error = -1;
    for (size_t i = 0; i < n; i++) {
        if (test_is_near((double)expected[i], (double)got[i], tolerance)) continue;
        double error = fabs((double)expected[i] - (double)got[i]);
        if (!test_finite(error)) error = 1e300;
        wrong++;
        if (error <= worst_error) continue;
        worst_error = error;
        worst = i;
    }
    if (wrong && test_fail(file, line))
        printf("%s[%lu]: expected %.9g, got %.9g, tolerance %.3g; %lu of %lu are off\n", what, (unsigned long)worst,
               (double)expected[worst], (double)got[worst], tolerance, (unsigned long)wrong, (unsigned long)n);
    return wrong == 0;
}

TEST_UNUSED static int test_equal(long long expected, long long got, const char *what, const char *file, int line)
{
    if (expected != got && test_fail(file, line)) printf("%s: expected %lld, got %lld\n", what, expected, got);
    return expected == got;
}

TEST_UNUSED static int test_same_bytes(size_t bytes, const void *expected, const void *got, const char *what,
                                       const char *file, int line)
{
    const unsigned char *a = (const unsigned char *)expected, *b = (const unsigned char *)got;
    size_t i = 0;
    while (i < bytes && a[i] == b[i]) i++;
    if (i < bytes && test_fail(file, line))
        printf("%s: byte %lu of %lu: expected %02x, got %02x\n", what, (unsigned long)i, (unsigned long)bytes,
               (unsigned)a[i], (unsigned)b[i]);
    return i == bytes;
}

TEST_UNUSED static int test_text(const char *part, const char *text, const char *what, const char *file, int line)
{
    int good = text && strstr(text, part) != NULL;
    if (!good && test_fail(file, line))
        printf("%s: expected to contain \"%s\", got \"%s\"\n", what, part, text ? text : "(NULL)");
    return good;
}

TEST_UNUSED static const char *test_status_name(dist_status status)
{
    switch (status) {
    case DIST_OK: return "DIST_OK";
    case DIST_BAD_ARGUMENT: return "DIST_BAD_ARGUMENT";
    case DIST_OUT_OF_MEMORY: return "DIST_OUT_OF_MEMORY";
    case DIST_BAD_FILE: return "DIST_BAD_FILE";
    case DIST_UNSUPPORTED: return "DIST_UNSUPPORTED";
    case DIST_NOT_FINITE: return "DIST_NOT_FINITE";
    case DIST_IO: return "DIST_IO";
    default: return "(no status)";
    }
}

TEST_UNUSED static int test_status(dist_status expected, dist_status got, const dist_context *ctx, const char *what,
                                   const char *file, int line)
{
    if (expected != got && test_fail(file, line))
        printf("%s: expected %s, got %s, message \"%s\"\n", what, test_status_name(expected), test_status_name(got),
               ctx ? dist_context_message(ctx) : "(no context)");
    return expected == got;
}

/* Each is worth 1 if it holds. Arguments are evaluated once. */
#define CHECK(condition) test_check((condition) ? 1 : 0, #condition, __FILE__, __LINE__)
#define CHECK_NEAR(expected, got, tolerance) \
    test_near((double)(expected), (double)(got), (double)(tolerance), #got, __FILE__, __LINE__)
#define CHECK_NEAR_ARRAY(n, expected, got, tolerance) \
    test_near_array((n), (expected), (got), (double)(tolerance), #got, __FILE__, __LINE__)
#define CHECK_EQUAL(expected, got) test_equal((long long)(expected), (long long)(got), #got, __FILE__, __LINE__)
#define CHECK_BYTES(bytes, expected, got) test_same_bytes((bytes), (expected), (got), #got, __FILE__, __LINE__)
#define CHECK_TEXT(part, text) test_text((part), (text), #text, __FILE__, __LINE__)
/* ctx may be NULL; its sentence is printed on failure. */
#define CHECK_STATUS(expected, got, ctx) test_status((expected), (got), (ctx), #got, __FILE__, __LINE__)

/* As CHECK, but ends the test: for what the rest of it cannot do without. */
#define REQUIRE(condition)             \
    do {                               \
        if (!CHECK(condition)) return; \
    } while (0)

/* ---- a counting, failing allocator ------------------------------------------------------------------------------- */

/* Counts what is live, returns memory aligned to what was asked for and to no more, filled with 0xff (NaN as a float),
   and checks at free that pointer and size are those of a live block and that nothing was written beyond its end.
   Zero it, set fail_at if wanted, and hand test_allocator_hook(&a) to the context. */
typedef struct test_allocator {
    size_t live_blocks, live_bytes, peak_bytes;
    size_t requests;  /* calls of alloc so far, refused ones included */
    size_t fail_at;   /* refuse the n-th request, counted from 1; 0: none */
    int fail_onwards; /* 1: and all after it */
    size_t refused;
    size_t errors; /* wrong sizes, alignments, pointers, writes beyond the end; each is also a failed check */
} test_allocator;

typedef struct test_block {
    uint64_t magic;
    void *memory; /* what malloc gave */
    size_t bytes;
    size_t alignment;
} test_block;

enum { TEST_FENCE = 64 };

/* Under the address sanitizer the fence may not even be read. */
#if defined(__SANITIZE_ADDRESS__)
#define TEST_ASAN
#elif defined(__has_feature)
#if __has_feature(address_sanitizer)
#define TEST_ASAN
#endif
#endif
#ifdef TEST_ASAN
#include <sanitizer/asan_interface.h>
#define TEST_POISON(p, bytes) __asan_poison_memory_region((p), (bytes))
#define TEST_UNPOISON(p, bytes) __asan_unpoison_memory_region((p), (bytes))
#else
#define TEST_POISON(p, bytes) ((void)0)
#define TEST_UNPOISON(p, bytes) ((void)0)
#endif

static const uint64_t test_block_magic = 0x74736964626c6f63u;

TEST_UNUSED static void test_allocator_error(test_allocator *a, const char *what, size_t number)
{
    a->errors++;
    if (test_fail(__FILE__, __LINE__)) printf("allocator: %s (%lu)\n", what, (unsigned long)number);
}

TEST_UNUSED static void *test_alloc(void *user, size_t bytes, size_t alignment)
{
    test_allocator *a = (test_allocator *)user;
    a->requests++;
    if (alignment == 0 || (alignment & (alignment - 1)) != 0 || alignment > 64) {
        test_allocator_error(a, "alignment is not a power of two up to 64", alignment);
        return NULL;
    }
    if (bytes == 0) test_allocator_error(a, "zero bytes were asked for", bytes);
    int refuse = a->fail_at != 0 && (a->requests == a->fail_at || (a->fail_onwards && a->requests > a->fail_at));
    if (refuse || bytes > (size_t)-1 / 4) {
        a->refused++;
        return NULL;
    }
    size_t room = sizeof(test_block) + 2 * alignment;
    unsigned char *memory = (unsigned char *)malloc(room + bytes + TEST_FENCE);
    if (!memory) {
        a->refused++;
        return NULL;
    }
    size_t shift = sizeof(test_block);
    while ((((uintptr_t)memory + shift) & (2 * alignment - 1)) != alignment) shift++;
    memset(memory + shift, 0xff, bytes);
    memset(memory + shift + bytes, 0xa5, TEST_FENCE);
    test_block block;
    block.magic = test_block_magic;
    block.memory = memory;
    block.bytes = bytes;
    block.alignment = alignment;
    memcpy(memory + shift - sizeof block, &block, sizeof block);
    TEST_POISON(memory + shift + bytes, TEST_FENCE);
    a->live_blocks++;
    a->live_bytes += bytes;
    if (a->live_bytes > a->peak_bytes) a->peak_bytes = a->live_bytes;
    return memory + shift;
}

TEST_UNUSED static void test_free(void *user, void *pointer, size_t bytes)
{
    test_allocator *a = (test_allocator *)user;
    unsigned char *p = (unsigned char *)pointer;
    test_block block;
    if (!p) {
        test_allocator_error(a, "NULL was freed", bytes);
        return;
    }
    memcpy(&block, p - sizeof block, sizeof block);
    if (block.magic != test_block_magic) {
        test_allocator_error(a, "what is freed is not a live block", bytes);
        return;
    }
    TEST_UNPOISON(p + block.bytes, TEST_FENCE);
    if (block.bytes != bytes) test_allocator_error(a, "freed with another size than it was taken with", bytes);
    for (size_t i = 0; i < TEST_FENCE; i++) {
        if (p[block.bytes + i] == 0xa5) continue;
        test_allocator_error(a, "something was written beyond the end of a block of this size", block.bytes);
        break;
    }
    a->live_blocks--;
    a->live_bytes -= block.bytes;
    void *memory = block.memory;
    memset(p - sizeof block, 0, sizeof block);
    memset(p, 0xff, block.bytes);
    free(memory);
}

TEST_UNUSED static dist_allocator test_allocator_hook(test_allocator *a)
{
    dist_allocator hook;
    hook.user = a;
    hook.alloc_fn = test_alloc;
    hook.free_fn = test_free;
    return hook;
}

/* ---- a scheduler without threads --------------------------------------------------------------------------------- */

/* Hands out tasks last first and a different worker each time, so that what depends on order or worker shows itself.
   Set workers, and the same in the context's desc. */
typedef struct test_scheduler {
    int workers;
    int calls;
} test_scheduler;

TEST_UNUSED static void test_schedule(void *user, int count, dist_task_fn task_fn, void *arg)
{
    test_scheduler *s = (test_scheduler *)user;
    s->calls++;
    for (int i = count - 1; i >= 0; i--) task_fn(arg, i, (i * 5 + s->calls) % s->workers);
}

TEST_UNUSED static dist_scheduler test_scheduler_hook(test_scheduler *s)
{
    dist_scheduler hook;
    hook.user = s;
    hook.run_fn = test_schedule;
    return hook;
}

/* ---- random numbers ---------------------------------------------------------------------------------------------- */

/* The same numbers everywhere for one seed. */
typedef struct test_random {
    uint64_t state;
} test_random;

TEST_UNUSED static test_random test_random_seed(uint64_t seed)
{
    test_random r;
    r.state = seed;
    return r;
}

TEST_UNUSED static uint64_t test_random_bits(test_random *r)
{
    r->state += 0x9e3779b97f4a7c15u; /* splitmix64 */
    uint64_t z = r->state;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

/* Uniform in low..high. */
TEST_UNUSED static double test_random_double(test_random *r, double low, double high)
{
    return low + (high - low) * ((double)(test_random_bits(r) >> 11) / 9007199254740992.0);
}

TEST_UNUSED static float test_random_float(test_random *r, float low, float high)
{
    return (float)test_random_double(r, (double)low, (double)high);
}

/* Uniform in low..high, both included. */
TEST_UNUSED static int test_random_int(test_random *r, int low, int high)
{
    uint64_t count = (uint64_t)((long long)high - (long long)low) + 1;
    return (int)((long long)low + (long long)(test_random_bits(r) % count));
}

TEST_UNUSED static void test_random_fill(test_random *r, size_t n, float *x, float low, float high)
{
    for (size_t i = 0; i < n; i++) x[i] = test_random_float(r, low, high);
}

TEST_UNUSED static double test_random_normal(test_random *r)
{
    double u = test_random_double(r, 1e-12, 1.0), v = test_random_double(r, 0.0, 6.283185307179586);
    return sqrt(-2.0 * log(u)) * cos(v);
}

/* Uniform on the unit sphere. */
TEST_UNUSED static void test_random_direction(test_random *r, float direction[3])
{
    double z = test_random_double(r, -1.0, 1.0), angle = test_random_double(r, 0.0, 6.283185307179586);
    double s = sqrt(1.0 - z * z);
    direction[0] = (float)(s * cos(angle));
    direction[1] = (float)(s * sin(angle));
    direction[2] = (float)z;
}

/* ---- environment ------------------------------------------------------------------------------------------------- */

/* 1: slow surroundings (an emulator, a sanitizer); make the cases smaller, but leave none out without SKIP. */
TEST_UNUSED static int test_quick(void)
{
    const char *text = getenv("DIST_TEST_QUICK");
    return text && text[0] && strcmp(text, "0") != 0;
}

/* DIST_ISA_* that DIST_TEST_ISA names; DIST_ISA_AUTO without one, -1 for a name that is none. */
TEST_UNUSED static int test_isa(void)
{
    const char *text = getenv("DIST_TEST_ISA");
    if (!text || !text[0] || !strcmp(text, "auto")) return DIST_ISA_AUTO;
    if (!strcmp(text, "scalar")) return DIST_ISA_SCALAR;
    if (!strcmp(text, "sse2")) return DIST_ISA_SSE2;
    if (!strcmp(text, "avx2")) return DIST_ISA_AVX2;
    if (!strcmp(text, "avx512")) return DIST_ISA_AVX512;
    if (!strcmp(text, "neon")) return DIST_ISA_NEON;
    return -1;
}

/* What this processor and build have, found without asking the library. */
TEST_UNUSED static int test_cpu_has(int isa)
{
    if (isa == DIST_ISA_AUTO || isa == DIST_ISA_SCALAR) return 1;
#if defined(DIST_NO_SIMD)
    return 0;
#elif defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
    __builtin_cpu_init();
    if (isa == DIST_ISA_SSE2) return 1;
    if (isa == DIST_ISA_AVX2) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (isa == DIST_ISA_AVX512)
        return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
               __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
    return 0;
#elif defined(__aarch64__)
    return isa == DIST_ISA_NEON;
#else
    return 0;
#endif
}

/* Zeroed, with the instruction set of DIST_TEST_ISA: start every context of a test from this. */
TEST_UNUSED static dist_context_desc test_context_desc(void)
{
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.isa = test_isa();
    return desc;
}

TEST_UNUSED static dist_context *test_context(void)
{
    dist_context_desc desc = test_context_desc();
    return dist_context_create(&desc);
}

/* The path of a file of the test data; good until the eighth call after this one. */
TEST_UNUSED static const char *test_path(const char *folder, const char *name)
{
    static char paths[8][512];
    static unsigned turn;
    char *path = paths[turn++ % 8];
    int length = snprintf(path, sizeof paths[0], "%s/%s", folder, name);
    if (length < 0 || (size_t)length >= sizeof paths[0]) path[0] = 0;
    return path;
}

TEST_UNUSED static const char *test_data_path(const char *name)
{
    const char *folder = getenv("DIST_DATA");
    return test_path(folder && folder[0] ? folder : "../shared/data", name);
}

/* A path to write to. */
TEST_UNUSED static const char *test_temp_path(const char *name)
{
    const char *folder = getenv("DIST_TMP");
    return test_path(folder && folder[0] ? folder : "build", name);
}

/* The whole file, a zero byte after its end, or NULL; give it back with free. size may be NULL. */
TEST_UNUSED static void *test_file_read(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    if (size) *size = 0;
    if (!file) return NULL;
    long length = fseek(file, 0, SEEK_END) == 0 ? ftell(file) : -1;
    unsigned char *bytes = NULL;
    if (length >= 0 && fseek(file, 0, SEEK_SET) == 0) bytes = (unsigned char *)malloc((size_t)length + 1);
    if (bytes && fread(bytes, 1, (size_t)length, file) != (size_t)length) {
        free(bytes);
        bytes = NULL;
    }
    fclose(file);
    if (!bytes) return NULL;
    bytes[length] = 0;
    if (size) *size = (size_t)length;
    return bytes;
}

/* First in main. */
TEST_UNUSED static void test_begin(int argc, char **argv)
{
    memset(&test_state, 0, sizeof test_state);
    test_state.program = argc > 0 ? argv[0] : "test";
    for (int i = 1; i < argc; i++) {
        if (!strcmp(argv[i], "-v"))
            test_state.verbose = 1;
        else
            test_state.filter = argv[i];
    }
    int isa = test_isa();
    if (isa < 0) {
        test_state.failed++;
        printf("not ok %s: DIST_TEST_ISA is %s, which is none\n", test_state.program, getenv("DIST_TEST_ISA"));
        test_state.nothing_runs = 1;
    } else if (!test_cpu_has(isa)) {
        test_state.skipped++;
        printf("skip %s: this processor or build has no %s\n", test_state.program, getenv("DIST_TEST_ISA"));
        test_state.nothing_runs = 1;
    } else if (isa != DIST_ISA_AUTO) {
        dist_context *ctx = test_context();
        if (dist_context_status(ctx) != DIST_OK || dist_context_isa(ctx) != isa) {
            test_state.failed++;
            printf("not ok %s: the library refuses this processor's %s: %s\n", test_state.program,
                   getenv("DIST_TEST_ISA"), ctx ? dist_context_message(ctx) : "(no context)");
            test_state.nothing_runs = 1;
        }
        dist_context_destroy(ctx);
    }
}

#endif
