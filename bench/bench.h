/* SPDX-License-Identifier: MIT-0
   bench.h - what the benchmarks share: test data, medians, what results belong to. Include it after common.h. */
#ifndef DIST_BENCH_BENCH_H
#define DIST_BENCH_BENCH_H

/* Machine and commit that plots are marked with: what `sh bench/machine.sh` prints, by DIST_ORIGIN. */
static inline const char *bench_origin(void)
{
    const char *origin = getenv("DIST_ORIGIN");
    return origin && origin[0] ? origin : "dist.h, run by hand: machine and commit not noted";
}

/* What an option names, if it was given, must be among what there is. */
static inline void check_found(const char *option, const char *name, int found)
{
    if (name && !found) { fail("%s %s: there is none of that name here", option, name); }
}

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

/* 2.2 radii away, azimuth 35, elevation 25 degrees, a focal length of 385 pixels at 512 (of the shorter side): then
   about 121,000 rays of 512 x 512 meet the bounding sphere, as in the paper's table of queries. */
static inline dist_camera bench_camera(const dist_field *field, int width, int height)
{
    const float azimuth = 35.0f * PI / 180.0f;
    const float elevation = 25.0f * PI / 180.0f;
    const float up[3] = {0, 1, 0};
    float r = 2.2f * field->radius;
    float eye[3];
    eye[0] = field->center[0] + r * cosf(elevation) * sinf(azimuth);
    eye[1] = field->center[1] + r * sinf(elevation);
    eye[2] = field->center[2] + r * cosf(elevation) * cosf(azimuth);
    dist_camera camera = dist_camera_look_at(width, height, 1.0f, eye, field->center, up);
    camera.fx = camera.fy = 385.0f * (float)(width < height ? width : height) / 512.0f;
    return camera;
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
