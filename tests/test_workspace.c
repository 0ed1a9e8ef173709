/* SPDX-License-Identifier: MIT-0
   dist_workspace_bytes: an arena of exactly so many bytes suffices, one with a byte less does not; and what memory
   grows with, and what not. */
#include "model.h"
#include "shapes.h"

/* Hands out one piece after another, each rounded up to 64 bytes, and takes nothing back. */
typedef struct bump {
    unsigned char *base;
    size_t size, used;
    long live;
} bump;

static void *bump_alloc(void *user, size_t bytes, size_t alignment)
{
    bump *b = (bump *)user;
    size_t whole = (bytes + 63) & ~(size_t)63;
    CHECK(bytes > 0 && alignment <= 64);
    if (whole > b->size - b->used) return NULL;
    void *p = b->base + b->used;
    b->used += whole;
    b->live++;
    memset(p, 0xff, bytes);
    return p;
}

static void bump_free(void *user, void *pointer, size_t bytes)
{
    bump *b = (bump *)user;
    CHECK((unsigned char *)pointer >= b->base && (unsigned char *)pointer + bytes <= b->base + b->used);
    b->live--;
}

/* A BLAS, plainly. */
static void plain_sgemm(void *user, int ta, int tb, int m, int n, int k, float alpha, const float *a, int lda,
                        const float *b, int ldb, float beta, float *c, int ldc)
{
    (void)user;
    for (int i = 0; i < m; i++) {
        for (int j = 0; j < n; j++) {
            float sum = 0;
            for (int l = 0; l < k; l++)
                sum += (ta ? a[l * lda + i] : a[i * lda + l]) * (tb ? b[j * ldb + l] : b[l * ldb + j]);
            c[i * ldc + j] = alpha * sum + (beta == 0 ? 0 : beta * c[i * ldc + j]);
        }
    }
}

enum { SIDE = 24, MOST_SHAPES = 3, MOST_INSTANCES = 7 };

typedef struct use {
    dist_workspace_desc desc;
    int made; /* objects that dist_workspace_desc names and that could be made */
    int wanted;
    char sentence[400];
    dist_status status;
} use;

/* Makes what desc says from the arena, renders it and goes back, and destroys all. */
static void use_run(use *u, bump *arena)
{
    static float planes[3][SIDE * SIDE], d_code[4096];
    static unsigned char mask[SIDE * SIDE];
    const dist_workspace_desc *d = &u->desc;
    dist_context_desc context = *d->context;
    dist_shape *shapes[MOST_SHAPES] = {NULL, NULL, NULL};
    dist_instance instances[MOST_INSTANCES];
    dist_scene *scene = NULL;
    dist_tape *tape = NULL;
    dist_cache *cache = NULL;
    dist_field field;
    dist_camera camera = dist_camera_look_at(SIDE, SIDE, 0.9f, (float[3]){0, 0, 4}, (float[3]){0, 0, 0},
                                             (float[3]){0, 1, 0});
    const float ball[4] = {0, 0, 0, 0.5f};
    int shape_count = !d->model && !d->net ? 0 : d->shapes ? d->shapes : 1;
    arena->used = 0;
    arena->live = 0;
    context.allocator.user = arena;
    context.allocator.alloc_fn = bump_alloc;
    context.allocator.free_fn = bump_free;
    u->wanted = 1 + (d->model != NULL) + (d->texture != NULL) + shape_count * (d->texture || d->texture_net ? 2 : 1) +
                (d->instances > 0) + (d->camera != NULL) + (d->cache != 0);
    u->made = 0;
    u->status = DIST_OUT_OF_MEMORY;
    strcpy(u->sentence, "no context");
    dist_context *ctx = dist_context_create(&context);
    if (!ctx) return;
    u->made++;
    dist_net *net = d->model ? dist_net_load(ctx, d->model, d->model_size) : NULL;
    dist_net *texture = d->texture ? dist_net_load(ctx, d->texture, d->texture_size) : NULL;
    u->made += (net != NULL) + (texture != NULL);
    const dist_net *shaped = net ? net : d->net, *colored = texture ? texture : d->texture_net;
    field = dist_field_sphere(ball);
    for (int i = 0; i < shape_count && shaped; i++) {
        shapes[i] = dist_shape_create(ctx, shaped, NULL);
        u->made += shapes[i] != NULL;
        if (shapes[i] && colored) u->made += dist_shape_set_texture(shapes[i], colored, NULL) == DIST_OK;
        if (shapes[i]) field = dist_shape_field(shapes[i]);
    }
    if (d->instances && shapes[0]) {
        memset(instances, 0, sizeof instances);
        for (int i = 0; i < d->instances; i++) {
            instances[i].field = &field;
            instances[i].placement.translation[0] = (float)i;
        }
        scene = dist_scene_create(ctx, d->instances, instances);
        u->made += scene != NULL;
        if (scene) field = dist_scene_field(scene);
    }
    if (d->camera) tape = dist_tape_create(ctx, d->camera, d->how);
    u->made += tape != NULL;
    if (d->cache) cache = dist_cache_create(ctx, &field, d->cache);
    u->made += cache != NULL;
    u->status = dist_context_status(ctx);
    memcpy(u->sentence, dist_context_message(ctx), strlen(dist_context_message(ctx)) + 1);
    if (u->made == u->wanted) { /* in use nothing is asked for */
        size_t used = arena->used;
        dist_images out, d_out;
        dist_gradients grads;
        memset(&out, 0, sizeof out);
        memset(&d_out, 0, sizeof d_out);
        memset(&grads, 0, sizeof grads);
        out.depth = planes[0];
        out.silhouette = planes[1];
        out.mask = mask;
        int taped = tape && field.eval_fn && d->camera->width == SIDE && d->camera->height == SIDE;
        dist_render_desc how;
        memset(&how, 0, sizeof how);
        if (d->how) how = *d->how;
        how.warm_start = how.warm_start && taped;
        for (int turn = 0; turn < 2 && field.eval_fn; turn++)
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, taped ? tape : NULL), ctx);
        for (int i = 0; i < SIDE * SIDE; i++) planes[2][i] = 1;
        d_out.depth = d_out.silhouette = planes[2];
        if (field.code_size > 0) grads.code = d_code;
        if (taped) CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        if (cache) CHECK_STATUS(DIST_OK, dist_cache_update(cache, &field), ctx);
        CHECK_EQUAL(used, arena->used);
    }
    dist_cache_destroy(cache);
    dist_tape_destroy(tape);
    dist_scene_destroy(scene);
    for (int i = 0; i < shape_count; i++) dist_shape_destroy(shapes[i]);
    dist_net_destroy(texture);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, arena->live);
}

/* Exactly enough, then a byte less; returns the bytes. */
static size_t use_check(use *u)
{
    static const char *const nothing = "";
    bump arena;
    size_t bytes = dist_workspace_bytes(&u->desc);
    CHECK(bytes > 0 && bytes % 64 == 0);
    unsigned char *memory = (unsigned char *)malloc(bytes + 63);
    if (!CHECK(memory != NULL)) return 0;
    memset(&arena, 0, sizeof arena);
    arena.base = memory + (64 - (uintptr_t)memory % 64) % 64;
    arena.size = bytes;
    use_run(u, &arena);
    CHECK_EQUAL(u->wanted, u->made);
    CHECK_EQUAL(bytes, arena.used);
    CHECK_EQUAL(DIST_OK, u->status);
    CHECK_TEXT(nothing, u->sentence);
    size_t less[3] = {1, 64, bytes / 2};
    for (int i = 0; i < 3; i++) {
        arena.size = bytes - less[i];
        use_run(u, &arena);
        CHECK(u->made < u->wanted);
        CHECK_EQUAL(DIST_OUT_OF_MEMORY, u->status);
        CHECK_TEXT(u->made ? ": out of memory" : "no context", u->sentence);
    }
    free(memory);
    return bytes;
}

/* Of each kind of net, or none, or one of another context, with settings drawn by lot. */
TEST(an_arena_of_exactly_so_many_bytes_suffices)
{
    static unsigned char texture[1 << 16];
    static const dist_net_desc color = {3, 64, 0, 45, 0, 0, 0, 0, 0, 1, 0, 1, 0, 5};
    static const dist_camera cameras[2] = {{20, 20, 12, 12, 0, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 4}, SIDE, SIDE, 0},
                                           {9, 9, 3, 3, 0, {1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 4}, 7, 300, 0}};
    dist_context *plain = test_context();
    dist_render_desc hows[3];
    test_scheduler scheduler;
    test_random r = test_random_seed(1);
    size_t texture_size, least = (size_t)-1, most = 0;
    memset(&scheduler, 0, sizeof scheduler);
    scheduler.workers = 3;
    memset(hows, 0, sizeof hows);
    hows[1].warm_start = 1;
    hows[2].trace = DIST_TRACE_PAPER;
    hows[2].samples = 3;
    dist_net *made = dist_net_create(plain, &color);
    CHECK_STATUS(DIST_OK, dist_net_save(plain, made, texture, sizeof texture, &texture_size), plain);
    for (int i = -1; i < MODEL_CASES; i++) {
        model m = model_make(&model_cases[i < 0 ? 0 : i], 7);
        size_t size;
        unsigned char *file = model_file(&m, &size);
        dist_net *kept = dist_net_load(plain, file, size);
        for (int turn = 0; turn < (test_quick() ? 2 : 6); turn++) {
            use u;
            dist_context_desc context = test_context_desc();
            int way = test_random_int(&r, 0, 2), tape = test_random_int(&r, 0, 2);
            memset(&u, 0, sizeof u);
            if (way == 1) {
                context.workers = 3;
                context.scheduler = test_scheduler_hook(&scheduler);
            } else if (way == 2) {
                context.blas.sgemm_fn = plain_sgemm;
                context.blas_width = 12;
            }
            u.desc.context = &context;
            if (i >= 0) {
                if (turn == 1) u.desc.net = kept;
                else u.desc.model = file, u.desc.model_size = size;
                u.desc.shapes = test_random_int(&r, 0, 3);
                if (m.sdf_channel >= 0) u.desc.instances = test_random_int(&r, -3, 7);
                if (u.desc.instances < 0) u.desc.instances = 0;
                int paint = test_random_int(&r, 0, 3);
                if (paint == 0) u.desc.texture = texture, u.desc.texture_size = texture_size;
                if (paint == 1) u.desc.texture_net = made;
            }
            if (tape) u.desc.camera = &cameras[tape - 1];
            if (turn % 2 && (i < 0 || m.sdf_channel >= 0)) u.desc.cache = test_random_int(&r, 0, 3) * 8;
            u.desc.how = tape ? &hows[test_random_int(&r, 0, 2)] : NULL;
            size_t bytes = use_check(&u);
            least = bytes < least ? bytes : least;
            most = bytes > most ? bytes : most;
        }
        dist_net_destroy(kept);
        free(file);
        model_free(&m);
    }
    CHECK(least < most / 3);
    dist_net_destroy(made);
    dist_context_destroy(plain);
}

typedef struct heard {
    int count;
    dist_status status;
    char message[400];
} heard;

static void hear(void *user, dist_status status, const char *message)
{
    heard *h = (heard *)user;
    h->count++;
    h->status = status;
    snprintf(h->message, sizeof h->message, "%s", message);
}

static void check_refused(const dist_workspace_desc *d, heard *h, dist_status status, const char *sentence)
{
    h->count = 0;
    CHECK_EQUAL(0, dist_workspace_bytes(d));
    CHECK_EQUAL(1, h->count);
    CHECK_EQUAL(status, h->status);
    CHECK_TEXT(sentence, h->message);
}

/* What a create function would refuse: 0, and its sentence to the logger. */
TEST(what_cannot_be_made_has_no_bytes_and_a_sentence)
{
    heard h;
    model m = model_make(&model_cases[0], 7);
    size_t size;
    unsigned char *file = model_file(&m, &size);
    test_allocator allocator;
    dist_context_desc context = test_context_desc();
    dist_workspace_desc good, d;
    dist_camera camera = shape_camera(9, 9);
    dist_render_desc how;
    memset(&h, 0, sizeof h);
    memset(&allocator, 0, sizeof allocator);
    memset(&how, 0, sizeof how);
    memset(&good, 0, sizeof good);
    context.allocator = test_allocator_hook(&allocator);
    context.logger.user = &h;
    context.logger.log_fn = hear;
    good.context = &context;
    good.model = file;
    good.model_size = size;
    good.camera = &camera;
    good.how = &how;
    CHECK(dist_workspace_bytes(&good) > 0);
    CHECK_EQUAL(0, h.count);
    CHECK_EQUAL(1, allocator.requests); /* the table of contents */
    d = good, d.model_size = 9;
    check_refused(&d, &h, DIST_BAD_FILE, "dist_net_load: the file has 9 bytes");
    d = good, d.model_size = size - 1;
    check_refused(&d, &h, DIST_BAD_FILE, "dist_net_load");
    d = good, d.shapes = -1;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "shapes is -1");
    d = good, d.instances = -1;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "instances -1");
    d = good, d.model = NULL, d.shapes = 1;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "0 without a net");
    d = good, d.model = NULL, d.shapes = 0, d.texture = file, d.texture_size = size;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "a texture is given, but net and model are NULL");
    d = good, d.texture = file, d.texture_size = size;
    check_refused(&d, &h, DIST_UNSUPPORTED, "no channels r,g,b");
    d = good, d.cache = 12;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "cache is 12, must be a multiple of 8 to 512 (0: none)");
    d = good, camera.width = 0;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "camera is 0 x 9");
    camera.width = 9, how.samples = 9;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "samples is 9");
    how.samples = 0, context.workers = -1;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "workers is -1");
    context.workers = 0, context.allocator.free_fn = NULL;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "context.allocator has one function of two");
    context.allocator = test_allocator_hook(&allocator);
    allocator.fail_at = allocator.requests + 1;
    check_refused(&d, &h, DIST_OUT_OF_MEMORY, "dist_workspace_bytes: out of memory");
    CHECK_EQUAL(0, allocator.live_blocks);
    CHECK(dist_workspace_bytes(NULL) > 0); /* a context by itself */
    free(file);
    model_free(&m);
}

/* As dist_scene_create refuses them. */
TEST(instances_that_make_no_scene_have_no_bytes)
{
    static const model_desc colors = {.channels = "r,g,b", .code_size = 3};
    dist_context *ctx = test_context();
    model m = model_make(&colors, 7);
    size_t size;
    unsigned char *file = model_file(&m, &size);
    heard h;
    dist_context_desc context = test_context_desc();
    dist_net_desc desc;
    dist_workspace_desc d;
    memset(&h, 0, sizeof h);
    memset(&desc, 0, sizeof desc);
    memset(&d, 0, sizeof d);
    context.logger.user = &h;
    context.logger.log_fn = hear;
    desc.layers = 2;
    desc.width = 4;
    desc.code_size = 2041; /* and seven numbers: 2^11 for each */
    dist_net *net = dist_net_create(ctx, &desc);
    d.context = &context;
    d.net = net;
    d.shapes = 1;
    d.instances = (1 << 20) - 1;
    CHECK(dist_workspace_bytes(&d) > 0);
    d.instances++;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "dist_workspace_bytes: the instances have no distance, or codes of more");
    d.net = NULL, d.model = file, d.model_size = size, d.instances = 0;
    CHECK(dist_workspace_bytes(&d) > 0);
    d.instances = 1;
    check_refused(&d, &h, DIST_BAD_ARGUMENT, "dist_workspace_bytes: the instances have no distance");
    dist_net_destroy(net);
    free(file);
    model_free(&m);
    dist_context_destroy(ctx);
}

/* They share what they keep for it; what one leaves there must not reach another's. */
TEST(shapes_in_turn_have_the_weight_gradients_that_each_has_alone)
{
    enum { MOST = 9000, POINTS = 150 };
    static float gradient[3][2][MOST], points[3 * POINTS], seeds[POINTS];
    test_random r = test_random_seed(3);
    test_random_fill(&r, 3 * POINTS, points, -0.6f, 0.6f);
    memset(gradient, 0, sizeof gradient);
    for (int mode = 0; mode < 3; mode++) { /* only one, only the other, both in turn */
        dist_context *ctx = test_context();
        dist_net *nets[2];
        dist_shape *shapes[2];
        for (int which = 0; which < 2; which++) {
            model m = model_make(&model_cases[MODEL_CASES - 1 - which], 7);
            nets[which] = model_load(ctx, &m);
            shapes[which] = dist_shape_create(ctx, nets[which], NULL);
            model_free(&m);
        }
        for (int turn = 0; turn < 4; turn++) {
            int which = mode < 2 ? mode : turn & 1;
            dist_field field = dist_shape_field(shapes[which]);
            dist_gradients grads;
            memset(&grads, 0, sizeof grads);
            REQUIRE(field.weight_count <= MOST);
            grads.weights = gradient[mode][which];
            memset(grads.weights, 0, sizeof gradient[0][0]);
            for (int i = 0; i < POINTS; i++) seeds[i] = (float)(i % 7) - 3.0f;
            CHECK_STATUS(DIST_OK,
                         dist_field_backward(ctx, &field, POINTS, points, seeds, NULL, NULL, NULL, &grads), ctx);
        }
        for (int which = 0; which < 2; which++) {
            dist_shape_destroy(shapes[which]);
            dist_net_destroy(nets[which]);
        }
        dist_context_destroy(ctx);
    }
    for (int which = 0; which < 2; which++) {
        double sum = 0;
        for (int i = 0; i < MOST; i++) sum += fabs((double)gradient[which][which][i]);
        CHECK(sum > 1);
        CHECK_BYTES(sizeof gradient[0][0], gradient[which][which], gradient[2][which]);
    }
}

/* With a net that is there; how: a tape for a picture of that side. */
static size_t net_bytes(const dist_net *net, int workers, int shapes, int side, const dist_render_desc *how)
{
    dist_context_desc context = test_context_desc();
    dist_workspace_desc d;
    test_scheduler scheduler;
    dist_camera camera = shape_camera(side, side);
    memset(&scheduler, 0, sizeof scheduler);
    memset(&d, 0, sizeof d);
    scheduler.workers = context.workers = workers;
    context.scheduler = test_scheduler_hook(&scheduler);
    d.context = &context;
    d.net = net;
    d.camera = how ? &camera : NULL;
    d.how = how;
    d.shapes = shapes;
    return dist_workspace_bytes(&d);
}

TEST(memory_is_that_of_tiles_without_a_tape_and_a_few_bytes_a_pixel_with_one)
{
    dist_context *ctx = test_context();
    dist_net_desc desc;
    dist_render_desc how;
    memset(&desc, 0, sizeof desc);
    memset(&how, 0, sizeof how);
    desc.skip = 4;
    desc.code_size = 256;
    dist_net *net = dist_net_create(ctx, &desc);
    REQUIRE(net != NULL);
    double pixels = 2048.0 * 2048.0;
    size_t none = net_bytes(net, 2, 1, 1, NULL), small = net_bytes(net, 2, 1, 256, &how);
    size_t large = net_bytes(net, 2, 1, 2048, &how);
    CHECK((double)none < 10.4e6);
    CHECK((double)large < 32e6);
    /* a tile's cost and place among the others, too: tiles of 64 x 64 pixels */
    CHECK_NEAR(5.0 * (pixels - 256.0 * 256.0) + 8.0 * (32 * 32 - 4 * 4), large - small, 0);
    CHECK((double)(net_bytes(net, 3, 1, 1, NULL) - none) < 3.5e6); /* another worker */
    CHECK((double)(net_bytes(net, 2, 101, 1, NULL) - none) < 100 * 32e3); /* another shape: its code and biases */
    how.warm_start = 1;
    double warm = (double)net_bytes(net, 2, 1, 2048, &how) - (double)large; /* five planes and the cones */
    CHECK(warm > 20.0 * pixels && warm < 22.5 * pixels);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* What a picture without a tape asks for and writes does not grow with it: all is in the context and the shape. */
TEST(a_large_picture_without_a_tape_takes_no_more_memory_than_a_small_one)
{
    const float numbers[5] = {0, 0, 0, 0.55f, 0.2f};
    size_t peaks[2];
    for (int i = 0; i < 2; i++) {
        int side = i ? test_quick() ? 512 : 2048 : 256;
        test_allocator allocator;
        dist_context_desc desc = test_context_desc();
        memset(&allocator, 0, sizeof allocator);
        desc.allocator = test_allocator_hook(&allocator);
        dist_context *ctx = dist_context_create(&desc);
        dist_field field = dist_field_torus(numbers);
        dist_camera camera = shape_camera(side, side);
        dist_images out;
        dist_stats stats;
        memset(&out, 0, sizeof out);
        size_t n = (size_t)side * (size_t)side, requests = allocator.requests;
        out.depth = (float *)malloc(n * sizeof(float));
        out.silhouette = (float *)malloc(n * sizeof(float));
        out.stats = &stats;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        CHECK(stats.hits > n / 20);
        CHECK_EQUAL(requests, allocator.requests);
        peaks[i] = allocator.peak_bytes;
        free(out.depth);
        free(out.silhouette);
        dist_context_destroy(ctx);
    }
    CHECK_EQUAL(peaks[0], peaks[1]);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(an_arena_of_exactly_so_many_bytes_suffices);
    RUN(what_cannot_be_made_has_no_bytes_and_a_sentence);
    RUN(instances_that_make_no_scene_have_no_bytes);
    RUN(shapes_in_turn_have_the_weight_gradients_that_each_has_alone);
    RUN(memory_is_that_of_tiles_without_a_tape_and_a_few_bytes_a_pixel_with_one);
    RUN(a_large_picture_without_a_tape_takes_no_more_memory_than_a_small_one);
    return test_report();
}
