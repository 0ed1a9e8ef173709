/* SPDX-License-Identifier: MIT-0
   What a scene does not need it does not pay for: the rows of bench/bench_needs.c, by their counts; and the reference
   in double that bench_work_precision measures against. */
#define TEST_INSIDE
#include "test.h"
#include "../examples/common.h"
#include "../bench/bench.h"
#include "../bench/exact.h"
#include "../bench/needs.h"

enum { SIZE = 96 };
static need_result results[NEEDS];

static const dist_stats *stats_of(int row) { return &results[row].stats; }

TEST(every_row_is_rendered)
{
    for (int i = 0; i < NEEDS; i++) {
        results[i] = need_run("embedded", 5, SIZE, 1, &needs[i]);
        const dist_stats *s = stats_of(i);
        int points = i == NEED_POINTS || i == NEED_POINTS_GRADIENT;
        CHECK_EQUAL(points ? 20 : SIZE * SIZE, s->rays);
        CHECK(s->hits > (points ? 10 : SIZE * SIZE / 10) && s->queries >= s->hits && s->queries < 4 * SIZE * SIZE);
        CHECK(s->operations_done > 0 && s->operations_done < s->operations);
    }
}

TEST(a_plane_that_is_not_wanted_costs_no_query)
{
    const dist_stats *depth = stats_of(NEED_DEPTH), *outline = stats_of(NEED_SILHOUETTE);
    const dist_stats *normals = stats_of(NEED_NORMALS);
    CHECK_EQUAL(0, depth->silhouette_queries + depth->normal_queries + depth->color_queries);
    CHECK(outline->silhouette_queries > 0);
    CHECK(outline->queries < depth->queries + 2 * outline->silhouette_queries);
    CHECK_EQUAL(0, outline->normal_queries);
    CHECK_EQUAL(normals->hits, normals->normal_queries); /* one each, value and gradient in one pass */
    CHECK_EQUAL(outline->queries + normals->hits, normals->queries);
}

TEST(a_gradient_costs_no_query_and_only_the_points_that_have_one)
{
    const dist_stats *depth = stats_of(NEED_DEPTH_GRADIENT), *all = stats_of(NEED_GRADIENT);
    CHECK_EQUAL(stats_of(NEED_NORMALS)->queries, all->queries);
    CHECK_EQUAL(stats_of(NEED_DEPTH)->queries, depth->queries);
    CHECK_EQUAL(depth->hits, depth->backward_points);
    CHECK(all->backward_points > depth->backward_points);
    for (int i = 0; i < NEEDS; i++)
        if (!(needs[i].planes & GRADIENT)) CHECK_EQUAL(0, stats_of(i)->backward_points);
}

TEST(twenty_points_cost_twenty_rays)
{
    const dist_stats *s = stats_of(NEED_POINTS);
    CHECK(s->queries <= 20 * 15);
    CHECK_EQUAL(s->queries, stats_of(NEED_POINTS_GRADIENT)->queries);
    CHECK_EQUAL(s->hits, stats_of(NEED_POINTS_GRADIENT)->backward_points);
}

TEST(a_static_camera_costs_about_two_queries_a_hit)
{
    const dist_stats *cold = stats_of(NEED_STEP), *warm = stats_of(NEED_WARM_STEP), *still = stats_of(NEED_WARM);
    CHECK(5 * warm->queries < cold->queries);
    CHECK_NEAR(cold->hits, warm->hits, 0.01 * (double)cold->hits);
    CHECK(still->queries < 2 * still->hits && 5 * still->queries < stats_of(NEED_DEPTH)->queries);
    CHECK_NEAR(stats_of(NEED_DEPTH)->hits, still->hits, 0.01 * (double)still->hits);
}

/* Nine more out of view are not asked: the field's work is at most that of the one by itself, which is in a smaller
   sphere there. */
TEST(instances_out_of_view_cost_nothing)
{
    CHECK(stats_of(NEED_TEN)->operations <= stats_of(NEED_DEPTH)->operations);
    CHECK_NEAR(stats_of(NEED_DEPTH)->hits, stats_of(NEED_TEN)->hits, 3); /* outlines: another sphere is entered */
}

/* At 512 x 512 from bench_camera. */
static void check_silhouette(const char *model, int code)
{
    enum { SIDE = 512 };
    static float depth[SIDE * SIDE], silhouette[SIDE * SIDE];
    dist_context *ctx = test_context();
    dist_net *net = load_net_or_skip(ctx, model);
    if (!net) {
        dist_context_destroy(ctx);
        SKIP("the real decoders are not here");
    }
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, code));
    dist_field field = dist_shape_field(shape);
    int side = test_quick() ? SIDE / 2 : SIDE; /* the outline is half as many pixels */
    dist_camera camera = bench_camera(&field, side, side);
    dist_stats plain, with;
    dist_images out;
    memset(&out, 0, sizeof out);
    memset(&plain, 0, sizeof plain);
    memset(&with, 0, sizeof with);
    out.depth = depth;
    out.stats = &plain;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
    out.silhouette = silhouette;
    out.stats = &with;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
    CHECK(with.queries > plain.queries && with.queries < plain.queries + (side < SIDE ? 30000 : 45000));
    if (test_state.verbose) printf("    %s: %llu of %llu\n", model, with.queries - plain.queries, with.queries);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(silhouette_of_the_embedded_model_costs_less_than_45000_queries) { check_silhouette("embedded", 5); }
TEST(silhouette_of_bob_costs_less_than_45000_queries) { check_silhouette("bob_spot", 0); }
TEST(silhouette_of_the_fox_costs_less_than_45000_queries) { check_silhouette("fox", 0); }
TEST(silhouette_of_rings_costs_less_than_45000_queries) { check_silhouette("rings", 0); }

TEST(memory_is_the_tracers_and_the_nets_and_a_tape_only_where_one_is_wanted)
{
    size_t none = results[NEED_DEPTH].bytes, tape = results[NEED_DEPTH_GRADIENT].bytes;
    size_t pixels = SIZE * SIZE;
    for (int i = 0; i < NEEDS; i++) {
        int planes = needs[i].planes;
        if (planes & TEN) continue;
        size_t cones = disti_round_up(disti_picture_cones(SIZE, SIZE) * sizeof(disti_cone), 64);
        size_t warm = planes & WARM ? 20 * pixels + cones : 0; /* five planes and the cones */
        CHECK_EQUAL(planes & (GRADIENT | WARM) ? tape + warm : none, results[i].bytes);
    }
    CHECK(tape - none < 5 * pixels + 1000000); /* the backward pass's own is the same for every picture */
    CHECK(results[NEED_TEN].bytes - none < 500000);
}

/* The benches' reference in double, against dist_field_eval (file NULL) or NAME.ref.f64 of the test data. */
static void check_exact(const char *model, int code, const char *file)
{
    enum { ROWS = 256 };
    static double points[3 * ROWS], f[ROWS], gradient[3 * ROWS], worst[3];
    size_t bytes = 0;
    dist_context *ctx = test_context();
    double *reference = file ? (double *)test_file_read(test_data_path(file), &bytes) : NULL;
    dist_net *net = file ? (reference ? load_net_or_skip(ctx, model) : NULL) : load_model(ctx, model);
    if (!net) {
        dist_context_destroy(ctx);
        SKIP("the real decoders are not here");
    }
    int n = dist_net_code_size(net), row = 7 + n;
    size_t rows = reference ? bytes / sizeof(double) / (size_t)row : ROWS;
    exact e = exact_create(net, dist_net_code(net, code));
    CHECK_EQUAL(ROWS, rows);
    for (size_t i = 0; i < ROWS; i++)
        for (size_t a = 0; a < 3; a++)
            points[3 * i + a] = reference ? reference[i * (size_t)row + a] : 0.1 * (double)(i * (7 + 4 * a) % 13) - 0.6;
    exact_eval(&e, ROWS, points, f, gradient, NULL);
    if (!reference) {
        float at[3 * ROWS], sdf[ROWS];
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, code));
        dist_field field = dist_shape_field(shape);
        for (size_t i = 0; i < 3 * ROWS; i++) at[i] = (float)points[i];
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, ROWS, at, sdf, NULL), ctx);
        for (size_t i = 0; i < ROWS; i++) CHECK_NEAR(f[i], (double)sdf[i], 2e-6);
        dist_shape_destroy(shape);
    }
    memset(worst, 0, sizeof worst);
    for (size_t i = 0; i < ROWS && reference; i++) {
        const double *r = reference + i * (size_t)row, one = 1;
        double *d_code = (double *)calloc((size_t)n + 1, sizeof *d_code), again, slope[3];
        exact_forget(&e);
        exact_eval(&e, 1, points + 3 * i, &again, slope, &one);
        exact_code(&e, d_code);
        worst[0] = fmax(worst[0], fabs(f[i] - r[3]));
        for (int a = 0; a < 3; a++) worst[1] = fmax(worst[1], fabs(gradient[3 * i + (size_t)a] - r[4 + a]));
        for (int j = 0; j < n; j++) worst[2] = fmax(worst[2], fabs(d_code[j] - r[7 + j]));
        free(d_code);
    }
    for (int k = 0; k < 3; k++) CHECK_NEAR(0, worst[k], 1e-6); /* weight norm is folded in single precision */
    if (test_state.verbose) printf("    %s: %.1e %.1e %.1e\n", model, worst[0], worst[1], worst[2]);
    exact_destroy(&e);
    free(reference);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(exact_of_the_embedded_model) { check_exact("embedded", 5, NULL); }
TEST(exact_of_bob_spot) { check_exact("bob_spot", 1, "nets/bob_spot.1.ref.f64"); }
TEST(exact_of_chairs) { check_exact("chairs", 3, "nets/chairs.3.ref.f64"); }
TEST(exact_of_two_spheres_sine) { check_exact("two_spheres_sine", 0, "nets/two_spheres_sine.ref.f64"); }
TEST(exact_of_round_cross) { check_exact("round_cross", 10, "nets/round_cross.10.ref.f64"); }
TEST(exact_of_mug) { check_exact("mug_camera_bottle", 0, "nets/mug_camera_bottle.0.ref.f64"); }
TEST(exact_of_fox) { check_exact("fox", 0, "nets/fox.ref.f64"); }

/* How many hits of a picture are farther from the root of the net in double than their bound: by |f| over the slope
   along the ray, both in double. */
static void count_beyond(const char *model, int code, int certified, int size)
{
    dist_context *ctx = test_context();
    dist_net *net = load_net_or_skip(ctx, model);
    if (!net) {
        dist_context_destroy(ctx);
        return;
    }
    const float *numbers = dist_net_code_size(net) ? dist_net_code(net, code) : NULL;
    dist_shape *shape = dist_shape_create(ctx, net, numbers);
    dist_field field = dist_shape_field(shape);
    dist_camera camera = bench_camera(&field, size, size);
    size_t n = (size_t)size * (size_t)size;
    exact e = exact_create(net, numbers);
    dist_images out;
    dist_render_desc how;
    memset(&out, 0, sizeof out);
    memset(&how, 0, sizeof how);
    how.certified = certified;
    out.distance = take_floats(n);
    out.error = take_floats(n);
    out.mask = (unsigned char *)take(n, 1);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
    int hits = 0, beyond = 0;
    double worst = 0;
    for (size_t i = 0; i < n; i++) {
        float origin[3], direction[3];
        double at[3], f, gradient[3], slope = 0;
        if (!out.mask[i]) continue;
        dist_camera_ray(&camera, (float)(i % (size_t)size), (float)(i / (size_t)size), origin, direction);
        for (int a = 0; a < 3; a++) at[a] = (double)origin[a] + (double)out.distance[i] * (double)direction[a];
        exact_eval(&e, 1, at, &f, gradient, NULL);
        for (int a = 0; a < 3; a++) slope += gradient[a] * (double)direction[a];
        double off = fabs(f) - fabs(slope) * ((double)out.error[i] + 3e-7 * (double)out.distance[i]); /* of the ray */
        hits++;
        beyond += off > 0;
        worst = fmax(worst, off);
    }
    if (test_state.verbose)
        printf("    %s, certified %d: %d of %d hits beyond their bound, |f| by %.1e at most\n", model, certified,
               beyond, hits, worst);
    CHECK(hits > 1000);
    CHECK(certified ? beyond == 0 : beyond * 1000 <= hits);
    free(out.distance);
    free(out.error);
    free(out.mask);
    exact_destroy(&e);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(bounds_hold_against_nets_in_double)
{
    for (int certified = 0; certified < 2; certified++) {
        count_beyond("embedded", 5, certified, 256);
        count_beyond("two_spheres_sine", 0, certified, 512);
        count_beyond("fox", 0, certified, 256);
        count_beyond("rings", 0, certified, 256);
    }
}

/* malloc's, filled: what a shape is found to gain by bounds must not depend on what the memory held before. */
static void *filled_alloc(void *user, size_t bytes, size_t alignment)
{
    unsigned char *raw = (unsigned char *)malloc(bytes + alignment);
    if (!raw) return NULL;
    size_t shift = alignment - (size_t)((uintptr_t)raw % alignment); /* 1 to alignment: kept in the byte before */
    raw[shift - 1] = (unsigned char)shift;
    memset(raw + shift, *(const unsigned char *)user, bytes);
    return raw + shift;
}

static void filled_free(void *user, void *p, size_t bytes)
{
    unsigned char *q = (unsigned char *)p;
    (void)user;
    (void)bytes;
    free(q - q[-1]);
}

TEST(a_shape_does_not_depend_on_what_its_memory_held)
{
    static unsigned char fills[] = {0x00, 0x01, 0x3f, 0x7f, 0x80, 0xff};
    static float depth[SIZE * SIZE];
    double done[sizeof fills];
    for (int i = 0; i < (int)sizeof fills; i++) {
        dist_context_desc desc;
        dist_images out;
        dist_stats stats;
        memset(&desc, 0, sizeof desc);
        memset(&out, 0, sizeof out);
        desc.allocator.user = &fills[i];
        desc.allocator.alloc_fn = filled_alloc;
        desc.allocator.free_fn = filled_free;
        dist_context *ctx = dist_context_create(&desc);
        dist_net *net = load_embedded(ctx);
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 0));
        dist_field field = dist_shape_field(shape);
        dist_camera camera = bench_camera(&field, SIZE, SIZE);
        out.depth = depth;
        out.stats = &stats;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        done[i] = stats.operations_done;
        CHECK_EQUAL(done[0], done[i]);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(every_row_is_rendered);
    RUN(a_plane_that_is_not_wanted_costs_no_query);
    RUN(a_gradient_costs_no_query_and_only_the_points_that_have_one);
    RUN(twenty_points_cost_twenty_rays);
    RUN(a_static_camera_costs_about_two_queries_a_hit);
    RUN(instances_out_of_view_cost_nothing);
    RUN(silhouette_of_the_embedded_model_costs_less_than_45000_queries);
    RUN(silhouette_of_bob_costs_less_than_45000_queries);
    RUN(silhouette_of_the_fox_costs_less_than_45000_queries);
    RUN(silhouette_of_rings_costs_less_than_45000_queries);
    RUN(memory_is_the_tracers_and_the_nets_and_a_tape_only_where_one_is_wanted);
    RUN(a_shape_does_not_depend_on_what_its_memory_held);
    RUN(exact_of_the_embedded_model);
    RUN(exact_of_bob_spot);
    RUN(exact_of_chairs);
    RUN(exact_of_two_spheres_sine);
    RUN(exact_of_round_cross);
    RUN(exact_of_mug);
    RUN(exact_of_fox);
    RUN(bounds_hold_against_nets_in_double);
    return test_report();
}
