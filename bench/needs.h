/* SPDX-License-Identifier: MIT-0
   needs.h - what a scene that needs less pays less for: the rows of bench_needs, which tests/test_needs.c holds it to.

   Each row is one picture of the embedded model or another, from the camera of the reference pictures, and where a
   gradient is wanted its adjoint. Memory is what the context, the shape and the tape hold, without the caller's planes
   and the weights. Include it after dist.h, common.h and bench.h. */
#ifndef DIST_BENCH_NEEDS_H
#define DIST_BENCH_NEEDS_H

enum { DEPTH = 1, SILHOUETTE = 2, NORMAL = 4, GRADIENT = 8, POINTS = 16, TEN = 32, WARM = 64, MOVING = 128 };
enum {
    NEED_DEPTH,
    NEED_SILHOUETTE,
    NEED_NORMALS,
    NEED_GRADIENT,
    NEED_DEPTH_GRADIENT,
    NEED_POINTS,
    NEED_POINTS_GRADIENT,
    NEED_TEN,
    NEED_STEP,
    NEED_WARM_STEP,
    NEED_WARM,
    NEEDS
};

typedef struct need {
    const char *name;
    int planes;
} need;

static const need needs[NEEDS] = {
    {"mask and depth", DEPTH},
    {"+ silhouette", DEPTH | SILHOUETTE},
    {"+ normals", DEPTH | SILHOUETTE | NORMAL},
    {"+ gradient for the code", DEPTH | SILHOUETTE | NORMAL | GRADIENT},
    {"depth and gradient for the code", DEPTH | GRADIENT},
    {"20 points of depth", DEPTH | POINTS},
    {"20 points and gradient for the code", DEPTH | GRADIENT | POINTS},
    {"one instance of ten in view", DEPTH | TEN},
    {"a step of a fit by depth and silhouette", DEPTH | SILHOUETTE | GRADIENT | MOVING},
    {"the same from a static camera: warm start", DEPTH | SILHOUETTE | GRADIENT | MOVING | WARM},
    {"mask and depth of what does not move: warm start", DEPTH | WARM},
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

typedef struct need_result {
    dist_stats stats; /* of the last repeat */
    double seconds;   /* median */
    size_t bytes;
} need_result;

/* One row. MOVING: the code is moved a little before each picture, as an optimizer does. */
static need_result need_run(const char *model, int code, int size, int repeats, const need *n)
{
    enum { MOST = 9 };
    need_result result;
    counter memory = {0};
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.allocator.user = &memory;
    desc.allocator.alloc_fn = count_alloc;
    desc.allocator.free_fn = count_free;
    dist_context *ctx = dist_context_create(&desc);
    dist_net *net = load_model(ctx, model);
    if (code >= dist_net_code_count(net)) { fail("--code %d: the model has %d", code, dist_net_code_count(net)); }
    size_t weights = memory.live;
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, code));
    dist_field field = dist_shape_field(shape);
    dist_scene *scene = NULL;
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    if (n->planes & TEN) { /* one in front of the camera, nine beside its view */
        dist_instance ten[10];
        memset(ten, 0, sizeof ten);
        for (int i = 0; i < 10; i++) {
            ten[i].field = &field;
            ten[i].placement.translation[0] = i ? -30.0f - 3.0f * (float)i : 0.0f;
        }
        scene = dist_scene_create(ctx, 10, ten);
        how.epsilon = 5e-5f * field.radius; /* the one's, not that of all ten's larger sphere */
        field = dist_scene_field(scene);
    }
    check(ctx);
    const float eye[3] = {1.3f, 0.95f, 1.9f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(size, size, 0.87f, eye, at, up);
    size_t pixels = (size_t)size * (size_t)size;
    unsigned char *mask = (unsigned char *)take(pixels, 1), *wanted = (unsigned char *)take(pixels, 1);
    float *depth = take_floats(pixels), *silhouette = take_floats(pixels), *normal = take_floats(3 * pixels);
    float *ones = take_floats(3 * pixels), *d_code = take_floats((size_t)dist_net_code_size(net) + 1);
    dist_images out, d_out;
    dist_gradients grads;
    dist_stats stats;
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
    how.warm_start = n->planes & WARM ? 1 : 0;
    dist_tape *tape = n->planes & (GRADIENT | WARM) ? dist_tape_create(ctx, &camera, &how) : NULL;
    d_out.depth = ones;
    d_out.silhouette = out.silhouette ? ones : NULL;
    d_out.normal = out.normal ? ones : NULL;
    d_out.stats = &stats;
    grads.code = d_code;
    double seconds[MOST];
    rng r = rng_begin(1);
    size_t code_size = (size_t)dist_net_code_size(net);
    float *moved = take_floats(code_size + 1);
    memcpy(moved, dist_net_code(net, code), code_size * sizeof(float));
    for (int i = n->planes & WARM ? -2 : 0; i < repeats && i < MOST; i++) { /* warm: two pictures not counted before */
        for (size_t j = 0; j < code_size && n->planes & MOVING; j++) { moved[j] += 2e-4f * (rng_uniform(&r) - 0.5f); }
        double begin = seconds_now();
        if (n->planes & MOVING) { dist_shape_set_code(shape, moved); }
        dist_render(ctx, &field, &camera, &how, &out, tape);
        if (n->planes & GRADIENT) { dist_render_backward(ctx, tape, &d_out, &grads); }
        if (i >= 0) { seconds[i] = seconds_now() - begin; }
        check(ctx);
    }
    free(moved);
    result.stats = stats;
    result.seconds = median((size_t)repeats, seconds);
    result.bytes = memory.live - weights;
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
    return result;
}

#endif
