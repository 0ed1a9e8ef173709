/* SPDX-License-Identifier: MIT-0
   bench.h - what the benchmarks share: test data, medians. Include it after common.h. */
#ifndef DIST_BENCH_BENCH_H
#define DIST_BENCH_BENCH_H

/* A network of the test data, which is not part of the repository: in DIST_DATA, or ../shared/data. */
static inline const char *net_path(char path[PATH_SIZE], const char *name)
{
    const char *folder = getenv("DIST_DATA");
    char stem[PATH_SIZE];
    int n = snprintf(stem, sizeof stem, "%s/nets/%s", folder && folder[0] ? folder : "../shared/data", name);
    if (n < 0 || (size_t)n >= sizeof stem) { fail("the name of the network %s is too long", name); }
    return path_of(path, stem, ".safetensors");
}

static inline int file_exists(const char *path)
{
    FILE *file = fopen(path, "rb");
    if (file) { fclose(file); }
    return file != NULL;
}

/* NULL, with a word on stderr, if the network is not there. */
static inline dist_net *load_net_or_skip(dist_context *ctx, const char *name)
{
    char path[PATH_SIZE];
#ifndef COMMON_MODEL
    if (strcmp(name, "embedded") == 0) {
        fputs("skip embedded: compiled without examples/model.h\n", stderr);
        return NULL;
    }
#endif
    if (strcmp(name, "embedded") == 0) { return load_model(ctx, name); }
    if (!file_exists(net_path(path, name))) {
        fprintf(stderr, "skip %s: %s is not there\n", name, path);
        return NULL;
    }
    return load_model(ctx, path);
}

static inline int compare_doubles(const void *a, const void *b)
{
    const double *x = (const double *)a;
    const double *y = (const double *)b;
    return *x < *y ? -1 : *x > *y;
}

/* The value below which `share` of the n values lie; sorts them. 0 if there are none. */
static inline double quantile(size_t n, double *values, double share)
{
    if (n == 0) { return 0; }
    qsort(values, n, sizeof *values, compare_doubles);
    return values[(size_t)(share * (double)(n - 1) + 0.5)];
}

static inline double median(size_t n, double *values)
{
    return quantile(n, values, 0.5);
}

#endif
