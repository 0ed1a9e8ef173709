/* SPDX-License-Identifier: MIT-0
   bench_needs.c - what a scene that needs less pays less for: queries, multiply-adds, seconds and bytes of memory of one
   picture and, where a gradient is wanted, its adjoint. CSV on stdout. Memory: what the context, the shape and the tape
   hold, without the caller's planes and the weights. The camera is that of the reference pictures. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "../examples/common.h"
#include "bench.h"

static const char usage[] =
    "bench_needs [options]\n"
    "  --model FILE       a decoder, or the word embedded (default)\n"
    "  --code N           its code (default 5)\n"
    "  --size N           pixels along a side (default 256)\n"
    "  --quick            96 pixels, each once\n";

enum { DEPTH = 1, SILHOUETTE = 2, NORMAL = 4, GRADIENT = 8, POINTS = 16, TEN = 32 };

typedef struct need {
    const char *name;
    int planes;
} need;

static const need needs[] = {
    {"mask and depth", DEPTH},
    {"+ silhouette", DEPTH | SILHOUETTE},
    {"+ normals", DEPTH | SILHOUETTE | NORMAL},
    {"+ gradient for the code", DEPTH | SILHOUETTE | NORMAL | GRADIENT},
    {"depth and gradient for the code", DEPTH | GRADIENT},
    {"20 points of depth", DEPTH | POINTS},
    {"20 points and gradient for the code", DEPTH | GRADIENT | POINTS},
    {"one instance of ten in view", DEPTH | TEN},
};

typedef struct counter {
    size_t live;
} counter;

static void *count_alloc(void *user, size_t bytes, size_t alignment)
{
    unsigned char *raw = (unsigned char *)malloc(bytes + alignment + sizeof(void *));
    if (!raw) { return NULL; }
    unsigned char *p = raw + sizeof(void *);
    while ((size_t)p % alignment) { p++; }
    memcpy(p - sizeof raw, &raw, sizeof raw);
    ((counter *)user)->live += bytes;
    return p;
}

static void count_free(void *user, void *pointer, size_t bytes)
{
    unsigned char *raw;
    memcpy(&raw, (unsigned char *)pointer - sizeof raw, sizeof raw);
    ((counter *)user)->live -= bytes;
    free(raw);
}

/* One row. The net is the caller's; all else is made here, so that its memory can be told. */
static void bench_need(const char *model, int code, int size, int repeats, const need *n)
{
    enum { MOST = 9 };
    counter memory = {0};
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.allocator.user = &memory;
    desc.allocator.alloc_fn = count_alloc;
    desc.allocator.free_fn = count_free;
    dist_context *ctx = dist_context_create(&desc);
    dist_net *net = load_model(ctx, model);
    size_t weights = memory.live;
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, code));
    dist_field field = dist_shape_field(shape);
    dist_scene *scene = NULL;
    if (n->planes & TEN) { /* one in front of the camera, nine beside its view */
        dist_instance ten[10];
        memset(ten, 0, sizeof ten);
        for (int i = 0; i < 10; i++) {
            ten[i].field = &field;
            ten[i].placement.translation[0] = i ? -30.0f - 3.0f * (float)i : 0.0f;
        }
        scene = dist_scene_create(ctx, 10, ten);
        field = dist_scene_field(scene);
    }
    check(ctx);
    const float eye[3] = {1.3f, 0.95f, 1.9f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(size, size, 0.87f, eye, at, up);
    size_t pixels = (size_t)size * (size_t)size;
    unsigned char *mask = (unsigned char *)take(pixels, 1), *wanted = (unsigned char *)take(pixels, 1);
    float *depth = take_floats(pixels), *silhouette = take_floats(pixels), *normal = take_floats(3 * pixels);
    float *ones = take_floats(3 * pixels), *d_code = take_floats((size_t)dist_net_code_size(net) + 1);
    dist_render_desc how;
    dist_images out, d_out;
    dist_gradients grads;
    dist_stats stats;
    memset(&how, 0, sizeof how);
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    for (size_t i = 0; i < 3 * pixels; i++) { ones[i] = 1; }
    for (size_t i = 0; i < 20; i++) { /* within the middle half of the picture */
        size_t half = (size_t)size / 2, x = i * 7919 % half, y = i * 104729 / 20 % half;
        wanted[(y + half / 2) * (size_t)size + x + half / 2] = 1;
    }
    if (n->planes & POINTS) { how.pixels = wanted; }
    out.mask = mask;
    out.depth = depth;
    out.stats = &stats;
    if (n->planes & SILHOUETTE) { out.silhouette = silhouette; }
    if (n->planes & NORMAL) { out.normal = normal; }
    dist_tape *tape = n->planes & GRADIENT ? dist_tape_create(ctx, &camera, &how) : NULL;
    d_out.depth = ones;
    d_out.silhouette = out.silhouette ? ones : NULL;
    d_out.normal = out.normal ? ones : NULL;
    d_out.stats = &stats;
    grads.code = d_code;
    double seconds[MOST];
    for (int i = 0; i < repeats && i < MOST; i++) {
        double begin = seconds_now();
        dist_render(ctx, &field, &camera, &how, &out, tape);
        if (tape) { dist_render_backward(ctx, tape, &d_out, &grads); }
        seconds[i] = seconds_now() - begin;
        check(ctx);
    }
    printf("%s,%d,%llu,%llu,%llu,%.4g,%.4g,%.4f,%.0f\n", n->name, size, stats.rays, stats.queries,
           stats.backward_points, stats.operations, stats.operations_done, median((size_t)repeats, seconds),
           (double)(memory.live - weights));
    fflush(stdout);
    dist_tape_destroy(tape);
    dist_scene_destroy(scene);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    free(mask);
    free(wanted);
    free(depth);
    free(silhouette);
    free(normal);
    free(ones);
    free(d_code);
}

int main(int argc, char **argv)
{
    const char *model = "embedded";
    int code = 5, size = 256, repeats = 7;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (option_is(&o, "--model")) {
            model = option_text(&o);
        } else if (option_is(&o, "--code")) {
            code = option_int(&o, 0, 1000);
        } else if (option_is(&o, "--size")) {
            size = option_int(&o, 8, 2048);
        } else if (option_is(&o, "--quick")) {
            option_flag(&o);
            size = 96;
            repeats = 1;
        } else {
            option_unknown(&o);
        }
    }
    printf("need,size,rays,queries,backward points,operations,operations done,seconds,bytes\n");
    for (size_t i = 0; i < sizeof needs / sizeof *needs; i++) { bench_need(model, code, size, repeats, &needs[i]); }
    return 0;
}
