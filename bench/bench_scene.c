/* SPDX-License-Identifier: MIT-0
   bench_scene.c - what a query of a scene costs, against one of the network that its instances share. CSV on stdout.
   Points lie in the instances' bounding spheres, as those that a tracer asks most; `net_queries` counts what the
   instances were asked, `of_one` is the time of a query over that of the network alone. The picture's rows count over
   its whole tracing. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"

static const char usage[] =
    "bench_scene [options]\n"
    "  --net MODEL        a file, or the word embedded (default)\n"
    "  --points N         of a batch (default 50000)\n"
    "  --size N           pixels along a side of the picture (default 256)\n"
    "  --quick            20000 points, 96 pixels\n";

enum { MOST = 20, REPEATS = 15 };

/* Points within the spheres of `count` instances, which stand on a grid of `spacing`; 256 for each in turn, as rays of
   one block ask. */
static void place(dist_instance *instances, int count, float spacing, float radius, size_t n, float *points,
                  float *local)
{
    rng random = rng_begin(7);
    for (int i = 0; i < count; i++) {
        const float move[7] = {0, rng_uniform(&random), rng_uniform(&random), rng_uniform(&random),
                               spacing * (float)(i % 5), spacing * (float)(i / 5 % 2), spacing * (float)(i / 10)};
        memset(&instances[i].placement, 0, sizeof instances[i].placement);
        dist_similarity_move(&instances[i].placement, move);
    }
    for (size_t i = 0; i < n; i++) {
        const float *t = instances[i / 256 % (size_t)count].placement.translation;
        float p[3], square;
        do {
            square = 0;
            for (int k = 0; k < 3; k++) {
                p[k] = radius * (2 * rng_uniform(&random) - 1);
                square += p[k] * p[k];
            }
        } while (square > radius * radius);
        for (size_t k = 0; k < 3; k++) {
            points[3 * i + k] = t[k] + p[k];
            local[3 * i + k] = p[k];
        }
    }
}

/* Least of several runs of each, the two in turn, so that both see the same machine. */
static void seconds_of(dist_context *ctx, const dist_field *alone, const dist_field *all, size_t n, const float *points,
                       const float *local, float *sdf, double least[2])
{
    for (int i = 0; i < 2 * REPEATS; i++) {
        double start = seconds_now();
        dist_field_eval(ctx, i % 2 ? all : alone, n, i % 2 ? points : local, sdf, NULL);
        double seconds = seconds_now() - start;
        if (i < 2 || seconds < least[i % 2]) { least[i % 2] = seconds; }
    }
    check(ctx);
}

static void picture(dist_context *ctx, const dist_field *field, dist_scene *scene, int size, dist_stats *stats,
                    double *seconds, double *asked)
{
    float *depth = take_floats((size_t)size * (size_t)size);
    const float up[3] = {0, 1, 0}, r = field->radius;
    float eye[3] = {field->center[0] + 1.2f * r, field->center[1] + 0.9f * r, field->center[2] + 1.7f * r};
    dist_camera camera = dist_camera_look_at(size, size, 0.8f, eye, field->center, up);
    dist_images out = {.depth = depth, .stats = stats};
    unsigned long long before = dist_scene_queries(scene);
    double start = seconds_now();
    dist_render(ctx, field, &camera, NULL, &out, NULL);
    check(ctx);
    *seconds = seconds_now() - start;
    *asked = scene ? (double)(dist_scene_queries(scene) - before) : (double)stats->queries;
    free(depth);
}

int main(int argc, char **argv)
{
    static const struct {
        const char *name;
        int count;
        float gap; /* between the spheres, radii */
    } rows[] = {{"alone", 0, 0}, {"one", 1, 0}, {"twenty_apart", 20, 0.3f}, {"twenty_touching", 20, 0}};
    const char *model = "embedded";
    int points = 50000, size = 256;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--net")) {
            model = option_text(&o);
        } else if (option_is(&o, "--points")) {
            points = option_int(&o, 1, 1 << 24);
        } else if (option_is(&o, "--size")) {
            size = option_int(&o, 8, 4096);
        } else if (option_is(&o, "--quick")) {
            points = option_flag(&o) * 20000;
            size = 96;
        } else {
            option_unknown(&o);
        }
    }
    dist_context_desc settings = {.workers = 1};
    dist_context *ctx = dist_context_create(&settings);
    dist_net *net = load_model(ctx, model);
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 0));
    dist_field field = dist_shape_field(shape);
    check(ctx);
    size_t n = (size_t)points;
    float *at = take_floats(3 * n), *local = take_floats(3 * n), *sdf = take_floats(n);
    printf("case,instances,points,net_queries,per_query,seconds,of_one,"
           "picture_queries,picture_net_queries,picture_per_query,picture_seconds\n");
    for (size_t i = 0; i < sizeof rows / sizeof rows[0]; i++) {
        dist_instance instances[MOST] = {{0}};
        dist_stats stats = {0};
        double drawn, asked, per = 1;
        int count = rows[i].count;
        for (int k = 0; k < count; k++) { instances[k].field = &field; }
        place(instances, count ? count : 1, (2 + rows[i].gap) * field.radius, field.radius, n, at, local);
        dist_scene *scene = count ? dist_scene_create(ctx, count, instances) : NULL;
        dist_field all = count ? dist_scene_field(scene) : field;
        check(ctx);
        double seconds[2];
        seconds_of(ctx, &field, &all, n, at, local, sdf, seconds);
        if (count) { per = (double)dist_scene_queries(scene) / ((double)n * REPEATS); }
        picture(ctx, &all, scene, size, &stats, &drawn, &asked);
        printf("%s,%d,%d,%.0f,%.3f,%.4f,%.3f,%llu,%.0f,%.3f,%.4f\n", rows[i].name, count, points, per * (double)n, per,
               seconds[1], seconds[1] / seconds[0], stats.queries, asked, asked / (double)stats.queries, drawn);
        fflush(stdout);
        dist_scene_destroy(scene);
    }
    free(at);
    free(local);
    free(sdf);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
