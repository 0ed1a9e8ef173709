/* SPDX-License-Identifier: MIT-0
   Contexts: hooks, memory that runs out anywhere, errors and their sentences, the caller's floating-point state.
   Numbers in comments are rows of the table of hard cases. */
#ifdef __linux__
#define _XOPEN_SOURCE 600 /* pthread_attr_setstack */
#endif
#include "shapes.h"

#if defined(__x86_64__) || defined(_M_X64)
#include <xmmintrin.h>
#else
#include <fenv.h>
#ifndef FE_UPWARD /* WebAssembly rounds to nearest only */
#define FE_UPWARD FE_TONEAREST
#define FE_DOWNWARD FE_TONEAREST
#define FE_TOWARDZERO FE_TONEAREST
#endif
#endif

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define SANITIZED
#elif defined(__clang__)
#if __has_feature(address_sanitizer) || __has_feature(thread_sanitizer)
#define SANITIZED
#endif
#endif
#if defined(__GLIBC__) && !defined(SANITIZED)
#if __GLIBC_PREREQ(2, 34) /* threads without an option */
#include <pthread.h>
#define OWN_STACKS
#endif
#endif

enum { W = 40, H = 30, CODE = 3 };

typedef struct pictures {
    float depth[W * H], normal[3 * W * H], silhouette[W * H];
    unsigned char mask[W * H];
    float code[CODE], rotation[3], translation[3];
} pictures;

static float weights[4096];

static dist_net_desc small_net(void)
{
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 3;
    desc.width = 16;
    desc.skip = 2;
    desc.code_size = CODE;
    desc.code_count = 1;
    desc.geometric = 1;
    desc.seed = 3;
    return desc;
}

static dist_images picture_planes(pictures *p, dist_stats *stats)
{
    dist_images out;
    memset(&out, 0, sizeof out);
    out.depth = p->depth;
    out.normal = p->normal;
    out.silhouette = p->silhouette;
    out.mask = p->mask;
    out.stats = stats;
    return out;
}

/* One of everything: made, used, destroyed. Notes in `calls` how many requests of memory the uses themselves made;
   returns how many of the creations failed. */
static int whole_life(test_allocator *allocator, const dist_context_desc *desc, pictures *p, size_t *calls)
{
    static unsigned char file[65536];
    float points[30], moments[2 * CODE], x[CODE] = {0, 0, 0};
    int failed = 0;
    size_t size = 0;
    dist_net_desc net_desc = small_net();
    dist_mesh_desc mesh_desc;
    dist_stats stats;
    dist_adam adam;
    dist_hit hit;
    memset(p, 0, sizeof *p);
    memset(&mesh_desc, 0, sizeof mesh_desc);
    memset(&adam, 0, sizeof adam);
    memset(moments, 0, sizeof moments);
    memset(weights, 0, sizeof weights);
    memset(points, 0, sizeof points); /* of a sample for which no memory was left */
    adam.moments = moments;
    mesh_desc.resolution = 12;
    mesh_desc.normals = 1;
    *calls = 0;
    dist_context *ctx = dist_context_create(desc);
    if (!ctx) return 1;
    dist_camera camera = shape_camera(W, H);
    dist_net *made = dist_net_create(ctx, &net_desc);
    failed += !made;
    if (made && dist_net_save(ctx, made, file, sizeof file, &size) != DIST_OK) failed++, size = 0;
    dist_net *net = size ? dist_net_load(ctx, file, size) : NULL;
    failed += size && !net;
    if (made) failed += dist_net_save_file(ctx, made, test_temp_path("context.safetensors")) != DIST_OK;
    dist_shape *shape = net ? dist_shape_create(ctx, net, NULL) : NULL;
    failed += net && !shape;
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    failed += !tape;
    if (shape) {
        dist_field field = dist_shape_field(shape);
        dist_images out = picture_planes(p, &stats), d_out;
        dist_gradients grads;
        size_t before = allocator->requests;
        CHECK_EQUAL(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape));
        memset(&d_out, 0, sizeof d_out);
        memset(&grads, 0, sizeof grads);
        static float ones[3 * W * H];
        for (int i = 0; i < 3 * W * H; i++) ones[i] = 1;
        d_out.depth = d_out.silhouette = d_out.normal = ones;
        grads.code = p->code;
        grads.rotation = p->rotation;
        grads.translation = p->translation;
        if (dist_net_weight_count(net) <= 4096) grads.weights = weights;
        if (tape) CHECK_EQUAL(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads));
        const float o[3] = {0, 0, 2}, d[3] = {0, 0, -1};
        CHECK_EQUAL(DIST_OK, dist_trace(ctx, &field, 1, o, d, NULL, &hit, NULL));
        CHECK_EQUAL(0, dist_adam_step(&adam, CODE, x, p->code));
        CHECK_EQUAL(DIST_OK, dist_shape_set_code(shape, x));
        *calls = allocator->requests - before;
        dist_mesh *mesh = dist_mesh_extract(ctx, &field, &mesh_desc);
        failed += !mesh;
        if (mesh && mesh->triangle_count) {
            dist_status status = dist_mesh_sample(ctx, mesh, 1, 10, points);
            CHECK(status == DIST_OK || status == DIST_OUT_OF_MEMORY);
            failed += status != DIST_OK;
            double chamfer;
            status = dist_chamfer(ctx, 10, points, 10, points, &chamfer, NULL);
            CHECK(status == DIST_OK || status == DIST_OUT_OF_MEMORY);
            failed += status != DIST_OK;
        }
        dist_mesh_destroy(mesh);
    }
    if (failed) {
        CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx);
        CHECK_TEXT(": out of memory", dist_context_message(ctx));
        CHECK(memcmp(dist_context_message(ctx), "dist_", 5) == 0);
    } else {
        CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    }
    dist_tape_destroy(tape);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_net_destroy(made);
    dist_context_destroy(ctx);
    return failed;
}

TEST(a_whole_life_leaks_nothing_and_keeps_to_sizes_and_alignment)
{
    static pictures p;
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    size_t calls;
    memset(&allocator, 0, sizeof allocator);
    desc.allocator = test_allocator_hook(&allocator);
    CHECK_EQUAL(0, whole_life(&allocator, &desc, &p, &calls));
    CHECK(allocator.requests > 10);
    CHECK_EQUAL(0, allocator.live_blocks);
    CHECK_EQUAL(0, allocator.live_bytes);
    CHECK_EQUAL(0, allocator.errors);
    int hits = 0;
    for (int i = 0; i < W * H; i++) hits += p.mask[i];
    CHECK(hits > 30);
    double moved = 0; /* a geometric start knows nothing of its code: no gradient there */
    for (int i = 0; i < 4096; i++) moved += fabs((double)weights[i]);
    CHECK(p.rotation[0] != 0 && p.translation[2] != 0 && moved > 0);
}

TEST(render_backward_trace_and_step_take_no_memory)
{
    static pictures p;
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    size_t calls = 99;
    memset(&allocator, 0, sizeof allocator);
    desc.allocator = test_allocator_hook(&allocator);
    CHECK_EQUAL(0, whole_life(&allocator, &desc, &p, &calls));
    CHECK_EQUAL(0, calls);
}

/* 44 */
TEST(memory_that_runs_out_anywhere_is_a_status_and_leaks_nothing)
{
    static pictures p;
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    size_t calls;
    memset(&allocator, 0, sizeof allocator);
    desc.workers = 1;
    desc.allocator = test_allocator_hook(&allocator);
    CHECK_EQUAL(0, whole_life(&allocator, &desc, &p, &calls));
    size_t requests = allocator.requests, step = test_quick() ? 3 : 1;
    for (int onwards = 0; onwards < 2; onwards++) {
        for (size_t n = 1; n <= requests; n += step) {
            memset(&allocator, 0, sizeof allocator);
            allocator.fail_at = n;
            allocator.fail_onwards = onwards;
            int failed = whole_life(&allocator, &desc, &p, &calls);
            int good = CHECK(failed > 0) & CHECK_EQUAL(0, allocator.live_blocks) & CHECK_EQUAL(0, allocator.errors);
            if (!good)
                printf("    request %lu of %lu, %s\n", (unsigned long)n, (unsigned long)requests,
                       onwards ? "from it on" : "once");
        }
    }
    if (test_state.verbose) printf("    %lu requests\n", (unsigned long)requests);
}

TEST(a_context_that_ran_out_of_memory_goes_on_once_it_is_there)
{
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    memset(&allocator, 0, sizeof allocator);
    desc.allocator = test_allocator_hook(&allocator);
    dist_context *ctx = dist_context_create(&desc);
    dist_camera camera = shape_camera(W, H);
    allocator.fail_at = allocator.requests + 1;
    allocator.fail_onwards = 1;
    CHECK(dist_tape_create(ctx, &camera, NULL) == NULL);
    CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx);
    allocator.fail_at = 0;
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    CHECK(tape != NULL);
    CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx); /* the first is kept until it is cleared */
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    dist_tape_destroy(tape);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, allocator.live_blocks);
}

TEST(half_an_allocator_makes_no_context)
{
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    memset(&allocator, 0, sizeof allocator);
    desc.allocator = test_allocator_hook(&allocator);
    desc.allocator.free_fn = NULL;
    CHECK(dist_context_create(&desc) == NULL);
    desc.allocator = test_allocator_hook(&allocator);
    desc.allocator.alloc_fn = NULL;
    CHECK(dist_context_create(&desc) == NULL);
    CHECK_EQUAL(0, allocator.requests);
}

/* 40 */
TEST(a_scheduler_of_any_order_gives_the_same_pictures_and_gradients)
{
    static pictures first, other;
    static float first_weights[4096];
    const int workers[4] = {1, 2, 5, 16};
    for (int k = 0; k < 4; k++) {
        test_allocator allocator;
        test_scheduler scheduler;
        dist_context_desc desc = test_context_desc();
        size_t calls;
        memset(&allocator, 0, sizeof allocator);
        scheduler.workers = desc.workers = workers[k];
        scheduler.calls = 0;
        desc.allocator = test_allocator_hook(&allocator);
        if (k > 0) desc.scheduler = test_scheduler_hook(&scheduler);
        CHECK_EQUAL(0, whole_life(&allocator, &desc, k ? &other : &first, &calls));
        CHECK_EQUAL(0, allocator.live_blocks);
        if (k == 0) memcpy(first_weights, weights, sizeof weights);
        if (k == 0) continue;
        CHECK(scheduler.calls > 2);
        CHECK_BYTES(sizeof first, &first, &other);
        CHECK_BYTES(sizeof weights, first_weights, weights);
    }
}

/* ---- what is refused -------------------------------------------------------------------------------------------- */

static void wrong_sgemm(void *user, int transpose_a, int transpose_b, int m, int n, int k, float alpha, const float *a,
                        int lda, const float *b, int ldb, float beta, float *c, int ldc)
{
    int garbage = *(const int *)user;
    for (int i = 0; i < m; i++) {
        for (int j = 0; j < n; j++) {
            float sum = 0;
            for (int l = 0; l < k; l++)
                sum += (transpose_a ? a[l * lda + i] : a[i * lda + l]) *
                       ((transpose_b != (garbage == 0)) ? b[j * ldb + l] : b[l * ldb + j]);
            if (garbage < 2) c[i * ldc + j] = alpha * sum + beta * c[i * ldc + j];
        }
    }
}

TEST(garbage_descs_come_back_as_a_context_that_says_so)
{
    test_allocator allocator;
    memset(&allocator, 0, sizeof allocator);
    for (int k = 0; k < 9; k++) {
        dist_context_desc desc = test_context_desc();
        test_scheduler scheduler;
        const char *part = "workers";
        int garbage = 0;
        scheduler.workers = 1;
        scheduler.calls = 0;
        desc.allocator = test_allocator_hook(&allocator);
        if (k == 0) desc.workers = -1;
        if (k == 1) desc.workers = 1025;
        if (k == 2) desc.isa = -1, part = "isa";
        if (k == 3) desc.isa = 99, part = "isa";
        if (k == 4) desc.scheduler = test_scheduler_hook(&scheduler);
        if (k == 5) desc.blas_width = -1, part = "blas_width";
        if (k >= 6) desc.blas.sgemm_fn = wrong_sgemm, desc.blas.user = &garbage, part = "blas.sgemm_fn"; /* 43 */
        garbage = k == 7 ? 2 : k == 8 ? 3 : 0;
        dist_context *ctx = dist_context_create(&desc);
        REQUIRE(ctx != NULL);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
        CHECK_TEXT("dist_context_create: ", dist_context_message(ctx));
        CHECK_TEXT(part, dist_context_message(ctx));
        CHECK_EQUAL(0, scheduler.calls);
        /* every further call fails with that status; clearing does not help */
        dist_context_clear(ctx);
        float ball[4] = {0, 0, 0, 0.5f}, depth[64], point[3] = {0, 0, 0}, f;
        dist_field field = dist_field_sphere(ball);
        dist_camera camera = shape_camera(8, 8);
        dist_net_desc net = small_net();
        dist_images out;
        dist_hit hit;
        memset(&out, 0, sizeof out);
        out.depth = depth;
        CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &camera, NULL, &out, NULL));
        CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_trace(ctx, &field, 1, point, ball + 1, NULL, &hit, NULL));
        CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_field_eval(ctx, &field, 1, point, &f, NULL));
        CHECK(dist_net_create(ctx, &net) == NULL && dist_net_load(ctx, "x", 1) == NULL);
        CHECK(dist_tape_create(ctx, &camera, NULL) == NULL && dist_mesh_extract(ctx, &field, NULL) == NULL);
        CHECK(dist_net_load_file(ctx, "none") == NULL && dist_mesh_load(ctx, "none") == NULL);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
        CHECK_TEXT(part, dist_context_message(ctx));
        dist_context_destroy(ctx);
        CHECK_EQUAL(0, allocator.live_blocks);
    }
    CHECK_EQUAL(0, allocator.errors);
}

TEST(a_scheduler_is_not_asked_for_no_tasks)
{
    dist_context_desc desc = test_context_desc();
    test_scheduler scheduler;
    float ball[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(ball);
    scheduler.workers = desc.workers = 2;
    desc.scheduler = test_scheduler_hook(&scheduler);
    dist_context *ctx = dist_context_create(&desc);
    scheduler.calls = 0;
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 0, NULL, NULL, NULL), ctx);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &field, 0, NULL, NULL, NULL, NULL, NULL), ctx);
    CHECK_STATUS(DIST_OK, dist_field_closest_point(ctx, &field, 0, NULL, NULL, NULL, NULL), ctx);
    CHECK_STATUS(DIST_OK, dist_field_collide(ctx, &field, 0, NULL, NULL), ctx);
    CHECK_EQUAL(0, scheduler.calls);
    dist_context_destroy(ctx);
}

/* 0: none is run; 1: every other; 2: each twice; 3: worker -1; 4: workers from 1 on; 5: indices from 1 on. */
static void wrong_schedule(void *user, int count, dist_task_fn task_fn, void *arg)
{
    int kind = *(const int *)user;
    for (int i = 0; i < count && kind; i += 1 + (kind == 1)) {
        task_fn(arg, i + (kind == 5), kind == 3 ? -1 : kind == 4 ? 1 + i % 2 : i % 2);
        if (kind == 2) task_fn(arg, i, 0);
    }
}

TEST(a_scheduler_that_does_not_do_what_it_should_is_refused)
{
    for (int kind = 0; kind < 6; kind++) {
        dist_context_desc desc = test_context_desc();
        desc.workers = 2;
        desc.scheduler.user = &kind;
        desc.scheduler.run_fn = wrong_schedule;
        dist_context *ctx = dist_context_create(&desc);
        REQUIRE(ctx != NULL);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
        CHECK_TEXT("scheduler.run_fn fails its self-test", dist_context_message(ctx));
        dist_context_destroy(ctx);
    }
}

/* Whose alignment is 4 from the `good`th allocation on. */
typedef struct askew {
    int good, held;
    size_t used;
    unsigned char memory[1 << 22];
} askew;

static void *askew_alloc(void *user, size_t bytes, size_t alignment)
{
    askew *a = (askew *)user;
    size_t start = a->used + alignment - (size_t)((uintptr_t)(a->memory + a->used) % alignment);
    if (bytes > sizeof a->memory || start + bytes + 4 > sizeof a->memory) return NULL;
    a->used = start + bytes + 4;
    a->held++;
    return a->memory + start + (a->good-- > 0 ? 0 : 4);
}

static void askew_free(void *user, void *pointer, size_t bytes)
{
    (void)pointer;
    (void)bytes;
    ((askew *)user)->held--;
}

TEST(an_allocator_that_ignores_the_alignment_is_refused)
{
    static askew a;
    for (int good = 0; good < 4; good++) {
        dist_context_desc desc = test_context_desc();
        float points[3] = {0, 0, 0};
        double chamfer;
        a.good = good;
        a.used = 0;
        desc.allocator.user = &a;
        desc.allocator.alloc_fn = askew_alloc;
        desc.allocator.free_fn = askew_free;
        dist_context *ctx = dist_context_create(&desc);
        if (good == 3) REQUIRE(ctx != NULL);
        if (ctx) {
            CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_chamfer(ctx, 1, points, 1, points, &chamfer, NULL), ctx);
            CHECK_TEXT("not aligned to 64", dist_context_message(ctx));
        }
        dist_context_destroy(ctx);
        CHECK_EQUAL(0, a.held);
    }
    a.good = 1000;
    a.used = 0;
    dist_context_desc desc = test_context_desc();
    dist_net_desc small;
    memset(&small, 0, sizeof small);
    small.layers = 3;
    small.width = 16;
    desc.allocator.user = &a;
    desc.allocator.alloc_fn = askew_alloc;
    desc.allocator.free_fn = askew_free;
    dist_context *ctx = dist_context_create(&desc);
    dist_net *net = dist_net_create(ctx, &small);
    REQUIRE(net != NULL);
    a.good = 0;
    dist_context *other = test_context(); /* the memory is the net's, not this one's */
    dist_status status = dist_net_set_half(other, net, DIST_HALF_AUTO);
    CHECK(status == DIST_UNSUPPORTED || status == DIST_OUT_OF_MEMORY);
    CHECK_TEXT(status == DIST_UNSUPPORTED ? "arithmetic" : "allocator.alloc_fn gave", dist_context_message(other));
    CHECK_EQUAL(DIST_HALF_OFF, dist_net_half(net));
    dist_context_destroy(other);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.held);
}

TEST(every_isa_is_in_force_or_refused_by_name)
{
    static const char *const names[6] = {"auto", "scalar", "sse2", "avx2", "avx512", "neon"};
    for (int isa = 0; isa <= DIST_ISA_NEON; isa++) {
        dist_context_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.isa = isa;
        dist_context *ctx = dist_context_create(&desc);
        REQUIRE(ctx != NULL);
        if (isa == DIST_ISA_AUTO) {
            CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
            CHECK(test_cpu_has(dist_context_isa(ctx)) && dist_context_isa(ctx) != DIST_ISA_AUTO);
        } else if (test_cpu_has(isa)) {
            CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
            CHECK_EQUAL(isa, dist_context_isa(ctx));
        } else {
            CHECK_STATUS(DIST_UNSUPPORTED, dist_context_status(ctx), ctx);
            CHECK_TEXT(names[isa], dist_context_message(ctx));
        }
        CHECK_TEXT(names[isa], dist_isa_name(isa));
        dist_context_destroy(ctx);
    }
}

TEST(null_is_refused_everywhere_without_a_crash)
{
    float x[16];
    double chamfer;
    size_t size;
    int w, h, c;
    dist_gradients grads;
    memset(x, 0, sizeof x);
    memset(&grads, 0, sizeof grads);
    for (int k = 0; k < 2; k++) {
        dist_context *ctx = k ? test_context() : NULL;
        CHECK(dist_net_load(ctx, NULL, 100) == NULL && dist_net_load_file(ctx, NULL) == NULL);
        CHECK(dist_shape_create(ctx, NULL, NULL) == NULL && dist_tape_create(ctx, NULL, NULL) == NULL);
        CHECK(dist_mesh_extract(ctx, NULL, NULL) == NULL && dist_mesh_create(ctx, 3, NULL, 1, NULL) == NULL);
        CHECK(dist_mesh_read(ctx, NULL, 10) == NULL && dist_mesh_load(ctx, NULL) == NULL);
        CHECK(dist_pfm_load(ctx, NULL, &w, &h, &c) == NULL);
        CHECK(dist_field_eval(ctx, NULL, 1, x, x, NULL) < 0);
        CHECK(dist_field_backward(ctx, NULL, 1, x, x, NULL, NULL, NULL, &grads) < 0);
        CHECK(dist_net_save(ctx, NULL, NULL, 0, &size) < 0);
        CHECK(dist_net_save_file(ctx, NULL, NULL) < 0);
        CHECK(dist_net_set_weights(ctx, NULL, x) < 0);
        CHECK(dist_net_set_code(ctx, NULL, 0, x) < 0);
        CHECK(dist_shape_eval(ctx, NULL, 1, x, x) < 0);
        CHECK(dist_trace(ctx, NULL, 1, x, x, NULL, NULL, NULL) < 0);
        CHECK(dist_render(ctx, NULL, NULL, NULL, NULL, NULL) < 0);
        CHECK(dist_render_backward(ctx, NULL, NULL, NULL) < 0);
        CHECK(dist_mesh_backward(ctx, NULL, NULL, x, &grads) < 0);
        CHECK(dist_mesh_sample(ctx, NULL, 0, 1, x) < 0);
        CHECK(dist_chamfer(ctx, 1, NULL, 1, NULL, &chamfer, NULL) < 0);
        CHECK(dist_pfm_write(ctx, 1, 1, 1, NULL, x, sizeof x, &size) < 0);
        CHECK(dist_pfm_read(ctx, NULL, 10, &w, &h, &c, NULL, 0) < 0);
        CHECK(dist_mesh_write(ctx, NULL, 0, NULL, 0, &size) < 0);
        CHECK(dist_mesh_save(ctx, NULL, NULL) < 0);
        CHECK(dist_context_status(ctx) < 0);
        CHECK(dist_context_message(ctx)[0] != 0);
        dist_pfm_free(ctx, NULL, 0, 0, 0);
        dist_context_clear(ctx);
        dist_context_destroy(ctx);
    }
    CHECK(dist_shape_set_code(NULL, x) < 0);
    CHECK(dist_shape_field(NULL).eval_fn == NULL && dist_scene_field(NULL).eval_fn == NULL);
    CHECK(dist_field_sphere(NULL).eval_fn == NULL && dist_field_torus(NULL).eval_fn == NULL);
    CHECK(dist_field_box(NULL).eval_fn == NULL);
    CHECK_EQUAL(0, dist_net_code_size(NULL));
    CHECK_EQUAL(0, dist_net_code_count(NULL));
    CHECK_EQUAL(0, dist_net_channels(NULL));
    CHECK(dist_net_code(NULL, 0) == NULL && dist_net_weights(NULL) == NULL);
    CHECK(dist_net_weight_count(NULL) == 0 && dist_net_operations(NULL, 1) == 0);
    CHECK_EQUAL(0, dist_context_workers(NULL));
    CHECK_EQUAL(DIST_ISA_AUTO, dist_context_isa(NULL));
    dist_net_destroy(NULL);
    dist_shape_destroy(NULL);
    dist_tape_destroy(NULL);
    dist_mesh_destroy(NULL);
}

typedef struct log_notes {
    int count;
    dist_status last;
    char text[400];
} log_notes;

static void note_log(void *user, dist_status status, const char *message)
{
    log_notes *n = (log_notes *)user;
    n->count++;
    n->last = status;
    (void)snprintf(n->text, sizeof n->text, "%s", message);
}

TEST(the_first_failure_is_kept_and_the_logger_told_all)
{
    log_notes n;
    dist_context_desc desc = test_context_desc();
    memset(&n, 0, sizeof n);
    desc.logger.user = &n;
    desc.logger.log_fn = note_log;
    dist_context *ctx = dist_context_create(&desc);
    float ball[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(ball);
    CHECK_EQUAL(0, n.count);
    CHECK_EQUAL(0, dist_context_message(ctx)[0]);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, NULL, NULL, NULL, NULL, NULL), ctx);
    char first[400];
    (void)snprintf(first, sizeof first, "%s", dist_context_message(ctx));
    CHECK_TEXT("dist_render: field is NULL", first);
    CHECK_EQUAL(1, n.count);
    CHECK(dist_net_load(ctx, "rubbish", 7) == NULL);
    CHECK_EQUAL(2, n.count);
    CHECK_EQUAL(DIST_BAD_FILE, n.last);
    CHECK(strcmp(n.text, first) != 0);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
    CHECK(strcmp(first, dist_context_message(ctx)) == 0);
    /* a failure does not stop the work after it */
    float point[3] = {0, 0, 1}, f = 0;
    CHECK_EQUAL(DIST_OK, dist_field_eval(ctx, &field, 1, point, &f, NULL));
    CHECK_NEAR(0.5, f, 1e-7);
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    CHECK_EQUAL(0, dist_context_message(ctx)[0]);
    CHECK(dist_net_load(ctx, "rubbish", 7) == NULL);
    CHECK_STATUS(DIST_BAD_FILE, dist_context_status(ctx), ctx);
    dist_context_destroy(ctx);
}

static void *no_memory(void *user, size_t bytes, size_t alignment)
{
    (void)user, (void)bytes, (void)alignment;
    return NULL;
}

static void no_free(void *user, void *pointer, size_t bytes) { (void)user, (void)pointer, (void)bytes; }

TEST(a_refused_context_tells_its_logger)
{
    log_notes n;
    dist_context_desc desc = test_context_desc();
    memset(&n, 0, sizeof n);
    desc.logger.user = &n;
    desc.logger.log_fn = note_log;
    desc.workers = -3;
    dist_context *ctx = dist_context_create(&desc);
    CHECK_EQUAL(1, n.count);
    CHECK_TEXT("workers is -3", n.text);
    dist_context_destroy(ctx);
    desc.workers = 1; /* and where there is none to keep the sentence */
    desc.allocator.alloc_fn = no_memory;
    CHECK(dist_context_create(&desc) == NULL);
    CHECK_EQUAL(2, n.count);
    CHECK_EQUAL(DIST_BAD_ARGUMENT, n.last);
    CHECK_TEXT("free_fn is NULL", n.text);
    desc.allocator.free_fn = no_free;
    CHECK(dist_context_create(&desc) == NULL);
    CHECK_EQUAL(3, n.count);
    CHECK_EQUAL(DIST_OUT_OF_MEMORY, n.last);
}

TEST(objects_of_another_context_are_refused)
{
    dist_context *ours = test_context(), *theirs = test_context();
    dist_net_desc desc = small_net();
    dist_camera camera = shape_camera(8, 8);
    dist_net *net = dist_net_create(theirs, &desc);
    dist_shape *shape = dist_shape_create(theirs, net, NULL), *shared = dist_shape_create(ours, net, NULL);
    dist_tape *tape = dist_tape_create(theirs, &camera, NULL);
    dist_field field = dist_shape_field(shape), good = dist_shape_field(shared);
    float depth[64], point[3] = {0, 0, 1}, f;
    dist_images out;
    dist_hit hit;
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    memset(&out, 0, sizeof out);
    out.depth = depth;
    CHECK(shared != NULL); /* nets are shared by contexts */
    CHECK_STATUS(DIST_OK, dist_render(ours, &good, &camera, NULL, &out, NULL), ours);
    const char *part = "another context";
    for (int k = 0; k < 7; k++) {
        dist_status status = DIST_OK;
        dist_context_clear(ours);
        if (k == 0) status = dist_render(ours, &field, &camera, NULL, &out, NULL);
        if (k == 1) status = dist_trace(ours, &field, 1, point, point, NULL, &hit, NULL);
        if (k == 2) status = dist_field_eval(ours, &field, 1, point, &f, NULL);
        if (k == 3) status = dist_render(ours, &good, &camera, NULL, &out, tape);
        if (k == 4) status = dist_mesh_extract(ours, &field, NULL) ? DIST_OK : dist_context_status(ours);
        if (k == 5) status = dist_shape_eval(ours, shape, 1, point, &f);
        if (k == 6) {
            CHECK_STATUS(DIST_OK, dist_render(theirs, &field, &camera, NULL, &out, tape), theirs);
            status = dist_render_backward(ours, tape, &out, &grads);
        }
        CHECK_STATUS(DIST_BAD_ARGUMENT, status, ours);
        CHECK_TEXT(part, dist_context_message(ours));
    }
    dist_tape_destroy(tape);
    dist_shape_destroy(shared);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ours);
    dist_context_destroy(theirs);
}

/* ---- floating-point state --------------------------------------------------------------------------------------- */

#if defined(__x86_64__) || defined(_M_X64)
enum { STATES = 7 };
static void state_set(int k)
{
    /* rounding down, up, to zero; flush to zero; traps for invalid, division by zero and overflow; all of it */
    const unsigned states[STATES] = {0x1f80u, 0x3f80u, 0x5f80u, 0x7f80u, 0x9fc0u, 0x1900u, 0x5900u};
    _mm_setcsr(states[k]);
}
static unsigned state_get(void)
{
    return _mm_getcsr() & ~0x3fu; /* without the flags of what has happened */
}
#else
enum { STATES = 4 };
static void state_set(int k)
{
    const int modes[STATES] = {FE_TONEAREST, FE_DOWNWARD, FE_UPWARD, FE_TOWARDZERO};
    fesetround(modes[k]);
}
static unsigned state_get(void)
{
    return (unsigned)fegetround();
}
#endif

/* Steeper than a float's square. */
static void steep_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        sdf[i] = 1e30f * points[3 * i];
        for (int k = 0; gradient && k < 3; k++) gradient[3 * i + (size_t)k] = k == 0 ? 1e30f : 0.0f;
    }
}

static int wild_asked; /* at points that are not finite */

/* Of all that is not, or hardly, finite; nobody says how steep. */
static void wild_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const uint32_t bits[5] = {0x7f7fffffu, 0xff7fffffu, 0x7f800000u, 0xff800000u, 0x7fc00000u};
    (void)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        int finite = test_finite_all(3, points + 3 * i);
        wild_asked += !finite;
        memcpy(sdf + i, bits + (finite ? (size_t)(100.0f * fabsf(points[3 * i])) % 5 : 0), sizeof *sdf);
        for (size_t k = 0; gradient && k < 3; k++) memcpy(gradient + 3 * i + k, bits + (i + k) % 5, sizeof *gradient);
    }
}

/* With traps on, what is not finite is told, or counted, by functions that run on the caller's own state, and traps
   nothing. */
TEST(what_is_not_finite_traps_nothing)
{
    const uint32_t bits = 0x7fc00000u;
    float nan, ball[4] = {0, 0, 0, 0.5f}, points[6] = {0.1f, 0.2f, 0.3f, 0.4f, 0.5f, 0.6f}, x[2] = {1, 2}, loss;
    float moments[4] = {0, 0, 0, 0}, gradient[2] = {1, 1}, step[7] = {0, 0, 0, 0, 0, 0, 0}, m[12];
    memcpy(&nan, &bits, sizeof nan);
    dist_context *ctx = shape_context();
    dist_field field = dist_field_sphere(ball);
    field.eval_fn = steep_eval;
    float bad[3] = {nan, 0, 1}, sphere[4] = {0, 0, 1, nan}, turned[9] = {nan, 0, 0, 0, 0, 0, 0, 0, 0};
    dist_contact contact;
    dist_similarity place;
    dist_adam adam;
    memset(&place, 0, sizeof place);
    memcpy(place.rotation, turned, sizeof turned);
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    adam.beta1 = adam.beta2 = adam.epsilon = nan;
    for (int i = 0; i < 12; i++) m[i] = nan;
    float colors[48], depth[16];
    dist_photo photo;
    dist_photometric_desc how;
    memset(&photo, 0, sizeof photo);
    memset(&how, 0, sizeof how);
    for (int i = 0; i < 48; i++) colors[i] = 0.5f;
    for (int i = 0; i < 16; i++) depth[i] = 1;
    photo.camera = dist_camera_look_at(4, 4, 0.7f, NULL, NULL, NULL);
    photo.color = colors;
    photo.depth = depth;
    how.ssim = points[4] = nan;
    static float wild_depth[64 * 64];
    dist_camera wide = dist_camera_look_at(64, 64, 0.7f, NULL, NULL, NULL);
    dist_field wild = field;
    dist_images out;
    dist_stats stats;
    memset(&out, 0, sizeof out);
    out.depth = wild_depth;
    out.stats = &stats;
    wild.eval_fn = wild_eval;
    wild.lipschitz = 0;
    state_set(STATES > 5 ? 5 : 0);
    dist_camera cameras[5] = {
        dist_camera_look_at(4, 4, nan, NULL, NULL, NULL), dist_camera_look_at(4, 4, 1e-45f, NULL, NULL, NULL),
        dist_camera_look_at(4, 4, 0.7f, bad, NULL, NULL), dist_camera_look_at(4, 4, 0.7f, NULL, bad, NULL),
        dist_camera_look_at(4, 4, 0.7f, NULL, NULL, bad)};
    dist_camera_set_opengl(&cameras[0], m);
    dist_similarity_move(&place, step);
    dist_status status = dist_field_collide(ctx, &field, 1, sphere, &contact);
    size_t skipped = dist_adam_step(&adam, 2, x, gradient);
    float none = dist_loss_photometric(&photo, &photo, &how, 1, NULL, NULL);
    dist_status term = dist_field_eikonal(ctx, &field, 2, points, 3e38f, &loss, NULL);
    dist_status seen = dist_render(ctx, &wild, &wide, NULL, &out, NULL);
    state_set(0);
    CHECK_STATUS(DIST_OK, seen, ctx);
    CHECK_EQUAL(0, wild_asked);
    CHECK(stats.rays == 64 * 64 && test_finite((double)stats.steepest) && stats.queries > 80);
    CHECK(none == 0.0f);
    CHECK_STATUS(DIST_OK, term, ctx);
    CHECK(loss > 3e38f);
    for (int k = 1; k < 5; k++) CHECK(cameras[k].fx == 0.0f);
    CHECK_STATUS(DIST_OK, status, ctx);
    CHECK_EQUAL(DIST_RAY_NOT_FINITE, contact.status);
    CHECK_EQUAL(0, skipped);
    CHECK(x[0] < 1 && x[1] < 2);
    dist_context_destroy(ctx);
}

#ifdef OWN_STACKS
/* A scheduler whose tasks run on a stack of its own, which tells how much of it they used. */
enum { STACK = 1 << 17, MARK = 0xa5 };
typedef struct stack_run {
    dist_task_fn task_fn;
    void *arg;
    int count;
} stack_run;
static unsigned char *stack_bytes;
static size_t stack_used;

static void *stack_main(void *user)
{
    const stack_run *run = (const stack_run *)user;
    for (int i = 0; i < run->count; i++) run->task_fn(run->arg, i, 0);
    return NULL;
}

static void stack_tasks(void *user, int count, dist_task_fn task_fn, void *arg)
{
    stack_run run = {task_fn, arg, count};
    pthread_attr_t attributes;
    pthread_t thread;
    size_t free_bytes = 0;
    (void)user;
    memset(stack_bytes, MARK, STACK);
    pthread_attr_init(&attributes);
    if (pthread_attr_setstack(&attributes, stack_bytes, STACK) != 0 ||
        pthread_create(&thread, &attributes, stack_main, &run) != 0)
        exit(1);
    pthread_join(thread, NULL);
    pthread_attr_destroy(&attributes);
    while (free_bytes < STACK && stack_bytes[free_bytes] == MARK) free_bytes++;
    if (STACK - free_bytes > stack_used) stack_used = STACK - free_bytes;
}
#endif

TEST(tasks_fit_on_small_stacks)
{
#ifdef OWN_STACKS
    static pictures p;
    unsigned char *memory = (unsigned char *)malloc(2 * STACK);
    size_t calls;
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    if (!memory) exit(1);
    stack_bytes = memory + (STACK - (uintptr_t)memory % STACK);
    memset(&allocator, 0, sizeof allocator);
    desc.workers = 1;
    desc.allocator = test_allocator_hook(&allocator);
    desc.scheduler.run_fn = stack_tasks;
    stack_used = 0;
    CHECK_EQUAL(0, whole_life(&allocator, &desc, &p, &calls));
    CHECK(stack_used > 1000 && stack_used <= 65536);
    for (int k = 0; k < 4; k++) { /* a wide net, one with all that a net can have, a texture; a scene, a cache, light */
        dist_context *ctx = dist_context_create(&desc);
        dist_net_desc form = small_net();
        form.width = k ? 40 : test_quick() ? 128 : 512;
        form.levels = k == 1 ? 6 : 0;
        form.activation = k == 1 ? DIST_ACTIVATION_SINE : k == 2 ? DIST_ACTIVATION_SOFTPLUS : DIST_ACTIVATION_RELU;
        form.geometric = k != 1;
        dist_net *net = dist_net_create(ctx, &form), *texture;
        form.color = 1;
        form.geometric = 0;
        form.code_size = 2 * CODE;
        texture = dist_net_create(ctx, &form);
        if (k == 3 && dist_net_set_half(ctx, net, DIST_HALF_BF16) != DIST_OK) dist_context_clear(ctx);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        CHECK_STATUS(DIST_OK, dist_shape_set_texture(shape, texture, NULL), ctx);
        dist_field field = dist_shape_field(shape);
        dist_cache *cache = dist_cache_create(ctx, &field, 16);
        dist_instance instances[2];
        memset(instances, 0, sizeof instances);
        instances[0].field = instances[1].field = &field;
        instances[1].placement.translation[0] = 1.5f;
        dist_scene *scene = dist_scene_create(ctx, 2, instances);
        dist_camera camera = shape_camera(W, H);
        dist_render_desc how;
        memset(&how, 0, sizeof how);
        how.samples = 2;
        dist_tape *tape = dist_tape_create(ctx, &camera, &how);
        static float color[3 * W * H], ones[3 * W * H], code_gradient[2 * (CODE + 7)], color_gradient[2 * CODE];
        dist_stats stats;
        for (int i = 0; i < 3 * W * H; i++) ones[i] = 1;
        for (int i = 0; i < 3; i++) {
            dist_field drawn = i == 2 ? dist_scene_field(scene) : field;
            dist_images out = picture_planes(&p, &stats), d_out;
            dist_gradients grads;
            out.color = color;
            if (i == 1) CHECK_STATUS(DIST_OK, dist_cache_update(cache, &field), ctx);
            if (i == 1) drawn = dist_cache_field(cache);
            CHECK_STATUS(DIST_OK, dist_render(ctx, &drawn, &camera, &how, &out, tape), ctx);
            memset(&d_out, 0, sizeof d_out);
            memset(&grads, 0, sizeof grads);
            d_out.depth = d_out.silhouette = d_out.normal = d_out.color = ones;
            grads.code = code_gradient;
            grads.color_code = color_gradient;
            grads.rotation = p.rotation;
            CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        }
        dist_tape_destroy(tape);
        dist_scene_destroy(scene);
        dist_cache_destroy(cache);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_net_destroy(texture);
        dist_context_destroy(ctx);
    }
    CHECK(stack_used <= 65536);
    if (test_state.verbose) printf("    %lu bytes of stack\n", (unsigned long)stack_used);
    free(memory);
#else
    SKIP("stacks of one's own take glibc 2.34, and no sanitizer");
#endif
}

/* 42: the state is the caller's again after every call, and no trap is sprung. */
TEST(the_callers_floating_point_state_neither_matters_nor_changes)
{
    static pictures first, other;
    for (int k = 0; k < STATES; k++) {
        test_allocator allocator;
        dist_context_desc desc = test_context_desc();
        size_t calls;
        int masks = 0, off = 0;
        memset(&allocator, 0, sizeof allocator);
        desc.workers = 1;
        desc.allocator = test_allocator_hook(&allocator);
        state_set(k);
        unsigned before = state_get();
        int failed = whole_life(&allocator, &desc, k ? &other : &first, &calls);
        unsigned after = state_get();
        state_set(0);
        CHECK_EQUAL(0, failed);
        CHECK_EQUAL(before, after);
        if (k == 0) continue;
        for (int i = 0; i < W * H; i++) {
            masks += first.mask[i] != other.mask[i];
            if (first.mask[i] && other.mask[i]) off += fabs((double)(first.depth[i] - other.depth[i])) > 5e-5;
        }
        CHECK(masks <= 1);
        CHECK_EQUAL(0, off);
        for (int i = 0; i < CODE; i++)
            CHECK_NEAR(first.code[i], other.code[i], 1e-3 * (1 + fabs((double)first.code[i])));
        for (int i = 0; i < 3; i++)
            CHECK_NEAR(first.rotation[i], other.rotation[i], 1e-3 * (1 + fabs((double)first.rotation[i])));
    }
}

/* Every desc's defaults are what _resolve says; what is not 0 stays, and a second one changes nothing. */
TEST(what_a_zeroed_desc_means_is_told)
{
    dist_context_desc context = dist_context_desc_resolve(NULL), same = dist_context_desc_resolve(&context);
    dist_context *ctx = dist_context_create(NULL);
    CHECK_EQUAL(dist_context_workers(ctx), context.workers);
    CHECK_EQUAL(dist_context_isa(ctx), context.isa);
    CHECK_EQUAL(192, context.blas_width);
    CHECK(same.workers == context.workers && same.isa == context.isa && same.blas_width == context.blas_width);
    context.isa = DIST_ISA_SCALAR;
    context.blas_width = 77;
    context = dist_context_desc_resolve(&context);
    CHECK(context.isa == DIST_ISA_SCALAR && context.blas_width == 77);
    dist_context_destroy(ctx);

    dist_mesh_desc mesh = dist_mesh_desc_resolve(NULL);
    CHECK_EQUAL(128, mesh.resolution);
    mesh.resolution = 5;
    CHECK_EQUAL(5, dist_mesh_desc_resolve(&mesh).resolution);
    dist_photometric_desc photo = dist_photometric_desc_resolve(NULL);
    CHECK_NEAR(1e-3, photo.visibility, 1e-9);
    photo.visibility = -1;
    CHECK_NEAR(-1, dist_photometric_desc_resolve(&photo).visibility, 0);
#ifndef DIST_NO_TRAIN
    const struct {
        int code_size, activation, color;
        float clamp, expected, scale;
    } nets[6] = {{0, DIST_ACTIVATION_RELU, 0, 0, 0, 100},     {4, DIST_ACTIVATION_RELU, 0, 0, 0.1f, 100},
                 {4, DIST_ACTIVATION_SINE, 1, 0, 0, 30},      {4, DIST_ACTIVATION_SOFTPLUS, 0, -1, -1, 100},
                 {0, DIST_ACTIVATION_RELU, 0, -2, -2, 100},    {0, DIST_ACTIVATION_RELU, 0, 0.3f, 0.3f, 100}};
    for (int k = 0; k < 6; k++) {
        dist_net_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.code_size = nets[k].code_size;
        desc.activation = nets[k].activation;
        desc.color = nets[k].color;
        desc.clamp = nets[k].clamp;
        dist_net_desc d = dist_net_desc_resolve(&desc);
        CHECK(d.layers == 8 && d.width == 512 && d.bound == 1);
        CHECK_NEAR(nets[k].scale, d.scale, 0);
        CHECK_NEAR(nets[k].expected, d.clamp, 0);
        CHECK_NEAR(nets[k].expected, dist_net_desc_resolve(&d).clamp, 0);
    }
    CHECK_EQUAL(512, dist_net_desc_resolve(NULL).width);
#endif
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(a_whole_life_leaks_nothing_and_keeps_to_sizes_and_alignment);
    RUN(render_backward_trace_and_step_take_no_memory);
    RUN(memory_that_runs_out_anywhere_is_a_status_and_leaks_nothing);
    RUN(a_context_that_ran_out_of_memory_goes_on_once_it_is_there);
    RUN(half_an_allocator_makes_no_context);
    RUN(a_scheduler_of_any_order_gives_the_same_pictures_and_gradients);
    RUN(garbage_descs_come_back_as_a_context_that_says_so);
    RUN(a_scheduler_is_not_asked_for_no_tasks);
    RUN(a_scheduler_that_does_not_do_what_it_should_is_refused);
    RUN(an_allocator_that_ignores_the_alignment_is_refused);
    RUN(every_isa_is_in_force_or_refused_by_name);
    RUN(null_is_refused_everywhere_without_a_crash);
    RUN(the_first_failure_is_kept_and_the_logger_told_all);
    RUN(a_refused_context_tells_its_logger);
    RUN(objects_of_another_context_are_refused);
    RUN(tasks_fit_on_small_stacks);
    RUN(what_is_not_finite_traps_nothing);
    RUN(the_callers_floating_point_state_neither_matters_nor_changes);
    RUN(what_a_zeroed_desc_means_is_told);
    return test_report();
}
