/* SPDX-License-Identifier: MIT-0
   results.h - what the programs share that make the paper's tables and figures: options, output files, the line that
   says where they were made. Include it after common.h.

   A program writes DIR/NAME.csv, DIR/NAME.svg or .png, and DIR/NAME.md, a section of RESULTS.md; results.sh runs all of
   them and puts the sections together. */
#ifndef DIST_BENCH_RESULTS_H
#define DIST_BENCH_RESULTS_H

typedef struct results {
    const char *out;  /* folder */
    const char *only; /* NULL: everything */
    int quick;
} results;

#define RESULTS_USAGE                                                                 \
    "  --only NAME        this one alone\n"                                           \
    "  --out DIR          folder of what is written (default bench/results)\n"        \
    "  --quick            small pictures, few cases: seconds, to see that all works\n"

/* DIR/NAME, without an ending: good until the next call. */
static inline const char *results_stem(const results *r, const char *name)
{
    static char stem[PATH_SIZE];
    char path[PATH_SIZE];
    path_of(path, r->out, "/");
    path_of(stem, path, name);
    make_folders(stem);
    return stem;
}

/* Tries whether the folder can be written to: better known before the work than after. */
static inline void results_check(const results *r)
{
    char path[PATH_SIZE];
    check_path(path_of(path, results_stem(r, "RESULTS"), ".md"));
}

static inline results results_options(int argc, char **argv, const char *help)
{
    results r;
    memset(&r, 0, sizeof r);
    r.out = "bench/results";
    options o = options_begin(argc, argv, help);
    while (option_next(&o)) {
        if (option_is(&o, "--only")) {
            r.only = option_text(&o);
        } else if (option_is(&o, "--out")) {
            r.out = option_text(&o);
        } else if (option_is(&o, "--quick")) {
            r.quick = option_flag(&o);
        } else {
            option_unknown(&o);
        }
    }
    results_check(&r);
    return r;
}

static inline int results_wanted(const results *r, const char *name)
{
    return !r->only || strcmp(r->only, name) == 0;
}

/* Processor with family and model, cores, compiler, and the commit if results.sh told it. */
static inline const char *results_machine(void)
{
    static char text[512];
    char line[256];
    char processor[256] = "unknown processor";
    const char *commit = getenv("DIST_COMMIT");
    long cores = 0, family = 0, model = 0;
    FILE *file = fopen("/proc/cpuinfo", "r");
    while (file && fgets(line, sizeof line, file)) {
        char *value = strchr(line, ':');
        if (strncmp(line, "processor", 9) == 0) { cores++; }
        if (value && strncmp(line, "cpu family", 10) == 0) { family = strtol(value + 1, NULL, 10); }
        if (value && strncmp(line, "model\t", 6) == 0) { model = strtol(value + 1, NULL, 10); }
        if (!value || strncmp(line, "model name", 10) != 0) { continue; }
        value[strcspn(value, "\n")] = 0;
        snprintf(processor, sizeof processor, "%s", value + 2);
    }
    if (file) { fclose(file); }
    size_t length = strlen(processor);
    if (family) { snprintf(processor + length, sizeof processor - length, " family %ld model %ld", family, model); }
#if defined(__clang__)
    const char *compiler = __VERSION__;
#elif defined(__GNUC__)
    const char *compiler = "gcc " __VERSION__;
#else
    const char *compiler = "unknown compiler";
#endif
    snprintf(text, sizeof text, "%s; %ld cores; %s; dist.h %s, commit %s", processor, cores, compiler, dist_version(),
             commit && commit[0] ? commit : "not told");
    return text;
}

/* DIR/NAME.csv: a line that begins with #, then the names of the columns. */
static inline FILE *results_csv(const results *r, const char *name, const char *columns)
{
    char path[PATH_SIZE];
    FILE *file = open_file(path_of(path, results_stem(r, name), ".csv"), "wb");
    fprintf(file, "# %s%s\n%s\n", results_machine(), r->quick ? "; quick" : "", columns);
    return file;
}

/* DIR/NAME.md: a section of RESULTS.md. */
static inline FILE *results_section(const results *r, const char *name, const char *title, const char *command)
{
    char path[PATH_SIZE];
    FILE *file = open_file(path_of(path, results_stem(r, name), ".md"), "wb");
    fprintf(file, "## %s\n\n`%s --only %s`%s; [%s.csv](%s.csv)  \n%s\n\n", title, command, name,
            r->quick ? " (quick)" : "", name, name, results_machine());
    return file;
}

static inline void results_close(const results *r, FILE *file, const char *name, const char *ending)
{
    char path[PATH_SIZE];
    close_file(file, path_of(path, results_stem(r, name), ending));
    puts(path);
    fflush(stdout);
}

/* This thread's processor time, so that what else the machine does counts for little. */
static inline double thread_seconds(void)
{
#ifdef CLOCK_THREAD_CPUTIME_ID
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
#else
    return seconds_now();
#endif
}

/* The middle of n values, of an even number the mean of the two in the middle; sorts them. */
static inline double results_median(size_t n, double *values)
{
    for (size_t i = 1; i < n; i++) {
        double value = values[i];
        size_t k = i;
        for (; k > 0 && values[k - 1] > value; k--) { values[k] = values[k - 1]; }
        values[k] = value;
    }
    return n ? 0.5 * (values[(n - 1) / 2] + values[n / 2]) : 0;
}

#endif
