/* SPDX-License-Identifier: MIT-0
   inside_half.h - networks in 16 bits: each kernel against f32, ragged sizes, overflow, what is refused */
#include "test.h"

#include "../examples/common.h"
#include "../bench/bench.h"
#include "model.h"

enum { POINTS = 200 };
static const int kinds[2] = {DIST_HALF_F16, DIST_HALF_BF16};

/* In this processor, this build and the context's instruction set. */
static int has(int kind)
{
    dist_context *ctx = test_context();
    int isa = dist_context_isa(ctx);
    dist_context_destroy(ctx);
    return isa == DIST_ISA_AVX512 && disti_cpu_half(kind);
}

static int any_half(void)
{
    return has(DIST_HALF_F16) ? DIST_HALF_F16 : has(DIST_HALF_BF16) ? DIST_HALF_BF16 : DIST_HALF_OFF;
}

#define NEEDS(what) \
    if (!(what)) SKIP("no 16-bit instructions in this processor, build or instruction set")

static void refused(dist_context *ctx, dist_status expected, dist_status status, const char *part)
{
    CHECK_EQUAL(expected, status);
    CHECK_TEXT(part, dist_context_message(ctx));
    dist_context_clear(ctx);
}

/* f at a point in double, and in *bound what rounding can do to it at most. With u half a unit in the last place, w~ =
   w (1 + u), x~ = x (1 + u) and sums of m terms, a unit's error is
       e'_o = sum_k |w_ok| (e_k + (2 u + g) (|x_k| + e_k)),   g = min(m, 128) u in f16, whose sums are that short,
   and activations pass it on by their steepest slope. */
static double reference(const dist_shape *shape, const float *p, double *bound)
{
    static double x[2][1024], e[2][1024];
    static float rows[128 * DISTI_BLOCK];
    const dist_net *net = shape->net;
    int f16 = net->half == DIST_HALF_F16, at = 0;
    disti_kernels kernels = disti_kernels_for(DIST_ISA_SCALAR);
    disti_encode(net, &kernels, 1, p, rows);
    for (int l = 0; l < net->layers; l++, at ^= 1) {
        const disti_linear *layer = &net->layer[l];
        int last = l + 1 == net->layers, count = layer->prev + layer->point;
        double u = last ? 0.0 : f16 ? 1.0 / 2048 : 1.0 / 256;
        double g = last || !f16 ? 2e-5 : u * (layer->prev < 128 ? layer->prev : 128);
        float scale = l == 0 ? net->first_scale : net->scale;
        for (int o = 0; o < (last ? net->sdf_channel + 1 : layer->out); o++) {
            double sum = (double)shape->bias[(size_t)l * (size_t)net->max_rows + (size_t)o], error = 0.0;
            for (int k = 0; k < count; k++) {
                size_t panel = last ? (size_t)(o * count + k) : (size_t)((o / 8 * count + k) * 8 + o % 8);
                double w = (double)net->panels[layer->panel + panel];
                double v = k < layer->prev ? x[at][k] : (double)rows[(k - layer->prev) * DISTI_BLOCK];
                double known = k < layer->prev ? e[at][k] : 0.0;
                sum += w * v;
                error += fabs(w) * (known + (k < layer->prev ? (2 * u + g) * (fabs(v) + known) + 1e-6 : 1e-6));
            }
            float slope;
            x[at ^ 1][o] = last ? sum : (double)disti_activate_one(net->activation, scale, (float)sum, &slope);
            e[at ^ 1][o] = error * (!last && net->activation == DIST_ACTIVATION_SINE ? (double)scale : 1.0) + 1e-6;
        }
    }
    double f = x[at][net->sdf_channel];
    *bound = e[at][net->sdf_channel];
    if (net->output == DISTI_OUTPUT_TANH || net->output == DISTI_OUTPUT_TANH_TWICE) f = tanh(f);
    if (net->output == DISTI_OUTPUT_TANH_TWICE) f = tanh(f);
    if (net->output == DISTI_OUTPUT_SIGMOID) f = 1.0 / (1.0 + exp(-f));
    return f - (double)net->level;
}

/* Evaluates the net in 16 bits in batches of several sizes: within the bound of f, the same bits in every batch, and
   not f32 under another name. Returns the largest error over its bound. */
static void check_net(dist_context *ctx, dist_net *net, int kind, const char *name)
{
    static const size_t sizes[] = {1, 16, 17, 33, 48, 49, 64, 65, 95, 96, 97, POINTS};
    float points[3 * POINTS], sdf[POINTS], half[POINTS], batch[POINTS];
    test_random random = test_random_seed(5);
    CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, kind), ctx);
    CHECK_EQUAL(kind, dist_net_half(net));
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field exact = dist_shape_field(shape), field = exact;
    CHECK(field.coarse_fn != NULL && field.coarse_error >= 0.0f);
    field.eval_fn = field.coarse_fn;
    test_random_fill(&random, 3 * POINTS, points, -0.6f, 0.6f);
    dist_field_eval(ctx, &exact, POINTS, points, sdf, NULL);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, POINTS, points, half, NULL), ctx);
    for (int i = 0; i < POINTS; i++) {
        double bound, f = reference(shape, points + 3 * i, &bound);
        MODEL_CHECK(fabs((double)half[i] - f) <= bound + 2e-6, name, "error, bound", fabs((double)half[i] - f), bound);
    }
    for (size_t k = 0; k < sizeof sizes / sizeof *sizes; k++) {
        memset(batch, 0xff, sizeof batch);
        dist_field_eval(ctx, &field, sizes[k], points, batch, NULL);
        MODEL_CHECK(memcmp(batch, half, sizes[k] * sizeof(float)) == 0, name, "other bits in a batch of", sizes[k], 0);
    }
    CHECK(net->layers < 3 || net->layer[0].out < 7 || memcmp(sdf, half, sizeof sdf) != 0);
    dist_shape_destroy(shape);
}

TEST(every_form_of_file_in_16_bits_is_within_its_bound_and_the_same_bits_in_every_batch)
{
    NEEDS(has(DIST_HALF_F16) || has(DIST_HALF_BF16));
    for (int j = 0; j < 2; j++) {
        if (!has(kinds[j])) continue;
        for (int k = 0; k < MODEL_CASES; k++) {
            model m = model_make(&model_cases[k], 100u + (unsigned)k);
            dist_context *ctx = test_context();
            dist_net *net = model_load(ctx, &m);
            if (net && net->sdf_channel >= 0 && !net->normed) check_net(ctx, net, kinds[j], m.desc.name);
            dist_net_destroy(net);
            dist_context_destroy(ctx);
            model_free(&m);
        }
    }
}

TEST(ragged_widths_in_16_bits)
{
    static const int widths[] = {1, 2, 3, 7, 8, 9, 15, 31, 33, 64, 70, 127, 128, 129, 300};
    NEEDS(has(DIST_HALF_F16) || has(DIST_HALF_BF16));
    for (size_t k = 0; k < 2 * sizeof widths / sizeof *widths; k++) {
        char name[32];
        if (!has(kinds[k & 1])) continue;
        dist_context *ctx = test_context();
        dist_net_desc desc;
        memset(&desc, 0, sizeof desc);
        desc.layers = 3;
        desc.width = widths[k / 2];
        desc.skip = desc.width > 3 ? 2 : 0;
        desc.code_size = desc.skip ? 2 : 0;
        desc.seed = 9;
        dist_net *net = dist_net_create(ctx, &desc);
        snprintf(name, sizeof name, "width %d", desc.width);
        check_net(ctx, net, kinds[k & 1], name);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

static dist_net *small_net(dist_context *ctx)
{
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 3;
    desc.width = 40;
    desc.geometric = 1;
    desc.output_linear = 1;
    desc.seed = 3;
    return dist_net_create(ctx, &desc);
}

/* Layer 0 times `factor`, layer 1's weights over it: ReLU nets stay the same function. */
static void stretch(dist_context *ctx, dist_net *net, float factor)
{
    size_t n = dist_net_weight_count(net);
    float *w = (float *)malloc(n * sizeof *w);
    memcpy(w, dist_net_weights(net), n * sizeof *w);
    for (size_t i = 0; i < net->layer[1].weight; i++) w[i] *= factor;
    for (size_t i = net->layer[1].weight; i < net->layer[1].bias; i++) w[i] /= factor;
    CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, w), ctx);
    free(w);
}

/* As where every block of points holds one that overflows. */
static void alone_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)worker, (void)points, (void)gradient;
    for (size_t i = 0; i < n; i++) sdf[i] = n > 1 ? 1.0f : *(const float *)user;
}

TEST(what_16_bits_are_off_is_measured_point_by_point_where_no_block_tells)
{
    float points[3 * DISTI_BLOCK] = {0}, sdf[DISTI_BLOCK], alone = 1.25f;
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = &alone;
    field.coarse_fn = alone_eval;
    for (size_t i = 0; i < DISTI_BLOCK; i++) sdf[i] = 1.0f;
    CHECK_EQUAL(0.25f, disti_coarse_apart(&field, points, sdf));
    sdf[7] = 0.5f; /* a block that tells is enough */
    CHECK_EQUAL(0.5f, disti_coarse_apart(&field, points, sdf));
    alone = INFINITY;
    sdf[7] = 1.0f;
    CHECK_EQUAL(0.0f, disti_coarse_apart(&field, points, sdf));
}

TEST(blocks_that_overflow_f16_are_evaluated_in_f32)
{
    float points[3 * POINTS], sdf[POINTS], half[POINTS];
    NEEDS(has(DIST_HALF_F16));
    dist_context *ctx = test_context();
    dist_net *net = small_net(ctx);
    stretch(ctx, net, 3e6f); /* the point's columns stay in f32: only the sums are too large */
    CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_F16), ctx);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    test_random random = test_random_seed(6);
    test_random_fill(&random, 3 * POINTS, points, -0.6f, 0.6f);
    dist_field_eval(ctx, &field, POINTS, points, sdf, NULL);
    field.eval_fn = field.coarse_fn;
    dist_field_eval(ctx, &field, POINTS, points, half, NULL);
    CHECK(memcmp(sdf, half, sizeof sdf) == 0 && disti_finite_all(POINTS, half));
    CHECK(field.coarse_error < 1e-2f); /* of the blocks of samples in which nothing overflows */
    stretch(ctx, net, 1e-13f); /* now layer 1's weights are too large */
    CHECK_EQUAL(DIST_HALF_OFF, dist_net_half(net));
    dist_shape_set_code(shape, NULL);
    dist_field_eval(ctx, &field, POINTS, points, half, NULL);
    CHECK_NEAR_ARRAY(POINTS, sdf, half, 1e-5);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* Sums that are infinite in bf16 are so in f32: what tells is that the points beside them have f32's bits. */
TEST(blocks_of_bf16_with_a_sum_that_is_not_finite_are_evaluated_in_f32)
{
    float points[3 * POINTS], sdf[POINTS], half[POINTS];
    NEEDS(has(DIST_HALF_BF16));
    dist_context *ctx = test_context();
    dist_net *net = small_net(ctx);
    stretch(ctx, net, 1e36f);
    CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_BF16), ctx);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    test_random random = test_random_seed(6);
    for (int far = 0; far < 2; far++) {
        test_random_fill(&random, 3 * POINTS, points, -0.6f, 0.6f);
        for (int i = 0; i < POINTS && far; i += DISTI_BLOCK) points[3 * i] = 1e6f;
        dist_field field = dist_shape_field(shape);
        dist_field_eval(ctx, &field, POINTS, points, sdf, NULL);
        field.eval_fn = field.coarse_fn;
        dist_field_eval(ctx, &field, POINTS, points, half, NULL);
        CHECK((memcmp(sdf, half, sizeof sdf) == 0) == far);
    }
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(new_weights_are_packed_again_gradients_stay_exact_and_off_is_f32)
{
    float points[3 * POINTS], sdf[POINTS], half[POINTS], gradient[2][3 * POINTS];
    const int kind = any_half();
    NEEDS(kind);
    dist_context *ctx = test_context();
    dist_net *net = small_net(ctx);
    CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, kind), ctx);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape), coarse = field;
    if (kind == DIST_HALF_F16 && has(DIST_HALF_BF16)) { /* whose error was not measured when the shape was made */
        CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_BF16), ctx);
        CHECK(dist_shape_field(shape).coarse_fn == NULL);
        CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_F16), ctx);
    }
    coarse.eval_fn = field.coarse_fn;
    test_random random = test_random_seed(6);
    test_random_fill(&random, 3 * POINTS, points, -0.6f, 0.6f);
    stretch(ctx, net, 2.0f);
    dist_shape_set_code(shape, NULL);
    dist_field_eval(ctx, &field, POINTS, points, sdf, gradient[0]);
    dist_field_eval(ctx, &coarse, POINTS, points, half, NULL);
    for (int i = 0; i < POINTS; i++) CHECK_NEAR((double)sdf[i], (double)half[i], kind == DIST_HALF_F16 ? 3e-3 : 2e-2);
    CHECK(memcmp(sdf, half, sizeof sdf) != 0);
    dist_field_eval(ctx, &coarse, POINTS, points, half, gradient[1]);
    CHECK(memcmp(gradient[0], gradient[1], sizeof gradient[0]) == 0);
    CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_OFF), ctx);
    CHECK_EQUAL(DIST_HALF_OFF, dist_net_half(net));
    dist_field_eval(ctx, &coarse, POINTS, points, half, NULL);
    CHECK(memcmp(sdf, half, sizeof sdf) == 0);
    CHECK(dist_shape_field(shape).coarse_fn == NULL);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(what_has_no_16_bits_is_refused)
{
    dist_context *ctx = test_context();
    dist_net *net = small_net(ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_set_half(NULL, net, DIST_HALF_F16), ctx);
    refused(ctx, DIST_BAD_ARGUMENT, dist_net_set_half(ctx, NULL, DIST_HALF_F16), "net is NULL");
    refused(ctx, DIST_BAD_ARGUMENT, dist_net_set_half(ctx, net, 4), "kind is 4");
    refused(ctx, DIST_BAD_ARGUMENT, dist_net_set_half(ctx, net, -1), "kind is -1");
    for (int j = 0; j < 2; j++)
        if (!disti_cpu_half(kinds[j]))
            refused(ctx, DIST_UNSUPPORTED, dist_net_set_half(ctx, net, kinds[j]), "arithmetic");
    stretch(ctx, net, 1e-7f);
    for (int kind = DIST_HALF_AUTO; kind <= DIST_HALF_F16; kind++)
        if (disti_cpu_half(DIST_HALF_F16)) refused(ctx, DIST_UNSUPPORTED, dist_net_set_half(ctx, net, kind), "65504");
    if (disti_cpu_half(DIST_HALF_BF16) && !disti_cpu_half(DIST_HALF_F16)) {
        CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_AUTO), ctx);
        CHECK_EQUAL(DIST_HALF_BF16, dist_net_half(net));
    }
    CHECK_EQUAL(DIST_HALF_OFF, dist_net_half(NULL));
    dist_net_destroy(net);
    for (int k = 0; k < MODEL_CASES; k++) {
        if (!model_cases[k].normed) continue;
        model m = model_make(&model_cases[k], 1);
        net = model_load(ctx, &m);
        for (int j = 0; j < 2; j++)
            if (disti_cpu_half(kinds[j]))
                refused(ctx, DIST_UNSUPPORTED, dist_net_set_half(ctx, net, kinds[j]), "LayerNorm");
        dist_net_destroy(net);
        model_free(&m);
    }
    dist_context_destroy(ctx);
}

TEST(another_instruction_set_has_no_coarse_fn)
{
    dist_context_desc desc;
    NEEDS(any_half());
    memset(&desc, 0, sizeof desc);
    desc.isa = DIST_ISA_AVX2;
    dist_context *ctx = dist_context_create(&desc);
    dist_net *net = small_net(ctx);
    CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_AUTO), ctx);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    CHECK(dist_shape_field(shape).coarse_fn == NULL);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

static dist_field in_16_bits(dist_field field)
{
    field.eval_fn = field.coarse_fn;
    field.fused_fn = NULL;
    return field;
}

/* A picture all in 16 bits: what it hits is the surface to within epsilon and the error of the values. */
TEST(a_picture_in_16_bits_is_off_by_no_more_than_its_values)
{
    enum { SIZE = 48 };
    static float distance[SIZE * SIZE];
    static unsigned char mask[SIZE * SIZE];
    const float eye[3] = {0.0f, 0.5f, 2.5f}, at[3] = {0.0f, 0.0f, 0.0f}, up[3] = {0.0f, 1.0f, 0.0f};
    NEEDS(has(DIST_HALF_F16) || has(DIST_HALF_BF16));
    for (int j = 0; j < 2; j++) {
        if (!has(kinds[j])) continue;
        dist_context *ctx = test_context();
        dist_net *net = small_net(ctx);
        dist_net_set_half(ctx, net, kinds[j]);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        dist_field field = dist_shape_field(shape), half = in_16_bits(field);
        dist_camera camera = dist_camera_look_at(SIZE, SIZE, 0.7f, eye, at, up);
        dist_images out;
        memset(&out, 0, sizeof out);
        out.distance = distance;
        out.mask = mask;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &half, &camera, NULL, &out, NULL), ctx);
        int hits = 0;
        for (int i = 0; i < SIZE * SIZE; i++) {
            float o[3], d[3], f;
            if (!mask[i]) continue;
            dist_camera_ray(&camera, (float)(i % SIZE), (float)(i / SIZE), o, d);
            for (int a = 0; a < 3; a++) o[a] += distance[i] * d[a];
            dist_field_eval(ctx, &field, 1, o, &f, NULL);
            CHECK_NEAR(0.0, (double)f, 1e-3 + 2.0 * (double)field.coarse_error);
            hits++;
        }
        CHECK(hits > SIZE);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

/* The bound of such a picture is one for the exact surface: what the values are off is in it, along the ray and aside.
   Without it four hits of five of the embedded model were beyond their bound in bf16; without what it moves aside some
   at outlines. */
static void check_bounds(dist_context *ctx, const char *name, dist_field field, dist_field half, int size)
{
    const float eye[3] = {1.3f, 0.9f, 1.5f}, at[3] = {0.0f, 0.0f, 0.0f}, up[3] = {0.0f, 1.0f, 0.0f};
    dist_camera camera = dist_camera_look_at(size, size, 0.7f, eye, at, up);
    size_t n = (size_t)size * (size_t)size;
    float *planes = (float *)malloc(5 * n * sizeof(float)), *exact = planes, *distance = planes + n;
    float *error = planes + 2 * n, *exact_error = planes + 3 * n, *plain_error = planes + 4 * n;
    dist_images out;
    REQUIRE(planes != NULL);
    memset(&out, 0, sizeof out);
    out.distance = exact;
    out.error = exact_error;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
    out.distance = distance;
    out.error = error;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &half, &camera, NULL, &out, NULL), ctx);
    half.coarse_fn = NULL; /* nobody says that it is off */
    out.distance = NULL;
    out.error = plain_error;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &half, &camera, NULL, &out, NULL), ctx);
    int hits = 0, within = 0, plain = 0;
    double mean = 0.0;
    for (size_t i = 0; i < n; i++) {
        if (!(error[i] > 0.0f && exact_error[i] > 0.0f)) continue;
        float off = fabsf(distance[i] - exact[i]) - exact_error[i];
        CHECK(error[i] * field.lipschitz > 2.0f * field.coarse_error);
        within += off <= error[i];
        plain += off <= plain_error[i];
        mean += (double)error[i];
        hits++;
    }
    if (test_state.verbose)
        printf("    %s: %d hits, %d within, %d in a plain bound; mean bound %.4f, f off by %.4f\n", name, hits, within,
               plain, mean / (hits > 0 ? hits : 1), (double)field.coarse_error);
    CHECK(hits > 8 * size && 1000 * (hits - within) <= hits);
    CHECK(10 * plain < 9 * hits);
    CHECK(mean < 0.1 * (double)field.radius * hits); /* and says something */
    free(planes);
}

TEST(error_bounds_of_a_picture_in_16_bits_count_in_what_its_values_are_off)
{
    const int codes[] = {0, 5, 20, 70};
    NEEDS(has(DIST_HALF_F16) || has(DIST_HALF_BF16));
    for (int j = 0; j < 8; j++) {
        if (!has(kinds[j % 2])) continue;
        dist_context *ctx = test_context();
        dist_net *net = dist_net_load_file(ctx, "examples/model.safetensors");
        REQUIRE(net != NULL);
        CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, kinds[j % 2]), ctx);
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, codes[j / 2]));
        dist_field field = dist_shape_field(shape);
        check_bounds(ctx, j % 2 ? "embedded, bf16" : "embedded, f16", field, in_16_bits(field), 96);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

/* Hits of a trained net in bf16 that are farther from certified ones in f32 than their bounds: 1 in 1000 at most. Wires
   a pixel wide and steps in depth are where there is little to be seen beside a ray. */
static void check_beyond(const char *name, float epsilon)
{
    enum { SIZE = 128, N = SIZE * SIZE };
    static float distance[N], exact[N], error[N];
    dist_context *ctx = test_context();
    dist_net *net = load_net_or_skip(ctx, name);
    if (!net) {
        dist_context_destroy(ctx);
        SKIP("a net is not there");
    }
    CHECK_STATUS(DIST_OK, dist_net_set_half(ctx, net, DIST_HALF_BF16), ctx);
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code_size(net) ? dist_net_code(net, 0) : NULL);
    dist_field field = dist_shape_field(shape), half = in_16_bits(field);
    dist_camera camera = bench_camera(&field, SIZE, SIZE);
    dist_render_desc how;
    dist_images out;
    memset(&how, 0, sizeof how);
    memset(&out, 0, sizeof out);
    out.distance = exact;
    how.epsilon = 1e-6f;
    how.certified = 1;
    how.lipschitz = 2.6f;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
    out.distance = distance;
    out.error = error;
    how.certified = 0;
    how.lipschitz = 0.0f;
    how.epsilon = epsilon;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &half, &camera, &how, &out, NULL), ctx);
    int hits = 0, beyond = 0;
    for (int i = 0; i < N; i++) {
        if (!(distance[i] > 0.0f && exact[i] > 0.0f)) continue;
        beyond += fabsf(distance[i] - exact[i]) > error[i] + 2e-6f;
        hits++;
    }
    if (test_state.verbose) printf("    %s: %d of %d hits beyond their bounds\n", name, beyond, hits);
    CHECK(hits > 2 * SIZE && beyond * 1000 < hits + 1000); /* rounded up */
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(error_bounds_in_bf16_hold_for_999_of_1000_hits_of_trained_nets)
{
    NEEDS(has(DIST_HALF_BF16));
    check_beyond("rings", 1e-2f); /* 5 of 4,730 without the margin behind a step in depth */
    check_beyond("mug_camera_bottle", 0.0f); /* 1 of 515 without that at an outline */
    check_beyond("mug_camera_bottle", 1e-3f);
    check_beyond("fox", 0.0f);
}

/* Any field's coarse_fn: a torus seen from above its side, off by waves of up to coarse_error. */
static void wavy_torus(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const dist_field *torus = (const dist_field *)user;
    torus->eval_fn(torus->user, worker, n, points, sdf, gradient);
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        sdf[i] += torus->coarse_error * sinf(29.0f * p[0] + 1.0f) * cosf(23.0f * p[1]) * sinf(31.0f * p[2] + 2.0f);
    }
}

TEST(error_bounds_count_in_what_any_coarse_fn_is_off)
{
    const float center_radii[5] = {0.0f, 0.0f, 0.0f, 0.5f, 0.2f};
    const float off[3] = {3e-4f, 2e-3f, 8e-3f};
    for (int j = 0; j < 9; j++) {
        dist_context *ctx = test_context();
        dist_field torus = dist_field_torus(center_radii);
        torus.coarse_error = off[j / 3];
        dist_field field = torus;
        field.user = &torus;
        field.coarse_fn = wavy_torus;
        field.eval_fn = wavy_torus;
        check_bounds(ctx, "torus", torus, field, 64 << j % 3);
        dist_instance one;
        memset(&one, 0, sizeof one);
        one.placement.scale = 3.0f;
        one.field = &torus;
        dist_scene *exact = dist_scene_create(ctx, 1, &one);
        one.field = &field;
        dist_scene *rough = dist_scene_create(ctx, 1, &one);
        CHECK_NEAR(3 * (double)off[j / 3], dist_scene_field(rough).coarse_error, 1e-6);
        check_bounds(ctx, "torus in a scene", dist_scene_field(exact), dist_scene_field(rough), 64 << j % 3);
        dist_scene_destroy(exact);
        dist_scene_destroy(rough);
        const float wrong[] = {-1e30f, (float)NAN, (float)INFINITY};
        for (int k = 0; k < 3; k++) {
            float f, p[3] = {0.0f, 0.0f, 0.0f};
            field.coarse_error = wrong[k];
            CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_field_eval(ctx, &field, 1, p, &f, NULL));
            CHECK(strstr(dist_context_message(ctx), "field.coarse_error") != NULL);
            dist_context_clear(ctx);
        }
        dist_context_destroy(ctx);
    }
}

static void run_half(void)
{
    RUN(every_form_of_file_in_16_bits_is_within_its_bound_and_the_same_bits_in_every_batch);
    RUN(ragged_widths_in_16_bits);
    RUN(what_16_bits_are_off_is_measured_point_by_point_where_no_block_tells);
    RUN(blocks_that_overflow_f16_are_evaluated_in_f32);
    RUN(blocks_of_bf16_with_a_sum_that_is_not_finite_are_evaluated_in_f32);
    RUN(new_weights_are_packed_again_gradients_stay_exact_and_off_is_f32);
    RUN(what_has_no_16_bits_is_refused);
    RUN(another_instruction_set_has_no_coarse_fn);
    RUN(a_picture_in_16_bits_is_off_by_no_more_than_its_values);
    RUN(error_bounds_of_a_picture_in_16_bits_count_in_what_its_values_are_off);
    RUN(error_bounds_in_bf16_hold_for_999_of_1000_hits_of_trained_nets);
    RUN(error_bounds_count_in_what_any_coarse_fn_is_off);
}
