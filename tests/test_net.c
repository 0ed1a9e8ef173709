/* SPDX-License-Identifier: MIT-0
   test_net.c - decoders: every form of the file, evaluated against double precision; folding, saving, making, refusing
 */
#include "test.h"

#include "model.h"

/* ---- help -------------------------------------------------------------------------------------------------------- */

enum { POINTS = 70 };

/* A model, the net loaded from its file, and a shape of it with a code. */
typedef struct net_case {
    const char *name;
    model m;
    dist_context *ctx;
    dist_net *net;
    dist_shape *shape;
    dist_field field;
    double code[MODEL_CODE];
    float codef[MODEL_CODE];
    float points[3 * POINTS];
} net_case;

static void case_close(net_case *c)
{
    dist_shape_destroy(c->shape);
    dist_net_destroy(c->net);
    dist_context_destroy(c->ctx);
    model_free(&c->m);
}

static int case_open(net_case *c, int index)
{
    memset(c, 0, sizeof *c);
    c->name = model_cases[index].name;
    c->m = model_make(&model_cases[index], 100u + (unsigned)index);
    c->ctx = test_context();
    c->net = model_load(c->ctx, &c->m);
    test_random random = test_random_seed(7u + (unsigned)index);
    for (int j = 0; j < c->m.desc.code_size; j++) {
        c->codef[j] = test_random_float(&random, -1.0f, 1.0f);
        c->code[j] = (double)c->codef[j];
    }
    c->shape = dist_shape_create(c->ctx, c->net, c->codef);
    c->field = dist_shape_field(c->shape);
    test_random_fill(&random, 3 * POINTS, c->points, -1.0f, 1.0f);
    if (!MODEL_CHECK(c->shape != NULL, c->name, dist_context_message(c->ctx), 1, 0)) {
        case_close(c);
        return 0;
    }
    return 1;
}

static void point_of(const net_case *c, int i, double p[3])
{
    for (int k = 0; k < 3; k++) p[k] = (double)c->points[3 * i + k];
}

/* Float rounding in front of sin(30 x) is magnified by 30. */
static double value_tolerance(const model *m) { return m->desc.activation == DIST_ACTIVATION_SINE ? 2e-5 : 2e-6; }

/* 10 h of the differences in model_gradient, as far as they move a pre-activation of these nets. */
static const double kink = 1e-4;

/* ---- values and gradients of every form -------------------------------------------------------------------------- */

TEST(every_form_of_file_gives_the_values_that_the_format_says)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        float channels[4 * POINTS], sdf[POINTS];
        double expected[4], worst = 0.0, p[3];
        if (!case_open(&c, k)) continue;
        CHECK_STATUS(DIST_OK, dist_shape_eval(c.ctx, c.shape, POINTS, c.points, channels), c.ctx);
        if (c.m.sdf_channel >= 0)
            CHECK_STATUS(DIST_OK, dist_field_eval(c.ctx, &c.field, POINTS, c.points, sdf, NULL), c.ctx);
        for (int i = 0; i < POINTS; i++) {
            point_of(&c, i, p);
            model_channels(&c.m, c.m.params, c.code, p, expected, NULL, NULL);
            for (int j = 0; j < c.m.channels; j++) {
                double got = (double)channels[i * c.m.channels + j], size = fmax(1.0, fabs(expected[j]));
                if (fabs(got - expected[j]) / size > worst) worst = fabs(got - expected[j]) / size;
            }
            if (c.m.sdf_channel >= 0)
                MODEL_CHECK(memcmp(&sdf[i], &channels[i * c.m.channels + c.m.sdf_channel], sizeof(float)) == 0, c.name,
                            "the field's value is the distance channel's", 0, (double)sdf[i]);
        }
        MODEL_CHECK(worst <= value_tolerance(&c.m), c.name, "largest error of a value", value_tolerance(&c.m), worst);
        case_close(&c);
    }
}

/* By the reverse pass, and of one to three points by themselves, with tangents. */
TEST(every_form_of_file_gives_point_gradients_that_match_differences)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        float sdf[POINTS], gradient[3 * POINTS], lone[3 * POINTS];
        double expected[3 * POINTS], closest, p[3], largest = 0.0, worst = 0.0, worst_lone = 0.0;
        int excluded = 0, use[POINTS];
        if (!case_open(&c, k)) continue;
        if (c.m.sdf_channel < 0) {
            case_close(&c);
            continue;
        }
        CHECK_STATUS(DIST_OK, dist_field_eval(c.ctx, &c.field, POINTS, c.points, sdf, gradient), c.ctx);
        for (int i = 0, n = 1; i < POINTS; i += n, n = n % 3 + 1) {
            n = i + n > POINTS ? POINTS - i : n;
            dist_field_eval(c.ctx, &c.field, (size_t)n, c.points + 3 * i, sdf, lone + 3 * i);
        }
        for (int i = 0; i < POINTS; i++) {
            point_of(&c, i, p);
            model_channels(&c.m, c.m.params, c.code, p, NULL, NULL, &closest);
            use[i] = closest > kink;
            excluded += !use[i];
            model_gradient(&c.m, c.m.params, c.code, p, expected + 3 * i);
            for (int j = 0; j < 3; j++) largest = fmax(largest, fabs(expected[3 * i + j]));
        }
        for (int i = 0; i < 3 * POINTS; i++) {
            if (!use[i / 3]) continue;
            worst = fmax(worst, fabs((double)gradient[i] - expected[i]) / largest);
            worst_lone = fmax(worst_lone, fabs((double)lone[i] - expected[i]) / largest);
        }
        MODEL_CHECK(worst <= 1e-4, c.name, "largest relative error of a gradient", 1e-4, worst);
        MODEL_CHECK(worst_lone <= 1e-4, c.name, "largest relative error of a lone gradient", 1e-4, worst_lone);
        MODEL_CHECK(10 * excluded <= POINTS, c.name, "points near kinks", POINTS / 10.0, excluded);
        case_close(&c);
    }
}

TEST(every_form_of_file_gives_code_gradients_that_match_differences)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        double closest, p[3], error = 0.0, size = 0.0, code[MODEL_CODE];
        int excluded = 0, n = model_cases[k].code_size;
        float one = 1.0f;
        const double h = 1e-6;
        if (n == 0) continue;
        if (!case_open(&c, k)) continue;
        for (int i = 0; i < POINTS && c.m.sdf_channel >= 0; i++) {
            float d_code[MODEL_CODE] = {0};
            dist_gradients grads;
            memset(&grads, 0, sizeof grads);
            grads.code = d_code;
            point_of(&c, i, p);
            model_channels(&c.m, c.m.params, c.code, p, NULL, NULL, &closest);
            excluded += closest <= kink;
            if (closest <= kink) continue;
            CHECK_STATUS(DIST_OK,
                         dist_field_backward(c.ctx, &c.field, 1, c.points + 3 * i, &one, NULL, NULL, NULL, &grads),
                         c.ctx);
            memcpy(code, c.code, sizeof code);
            for (int j = 0; j < n; j++) {
                code[j] = c.code[j] + h;
                double expected = model_eval(&c.m, c.m.params, code, p);
                code[j] = c.code[j] - h;
                expected = (expected - model_eval(&c.m, c.m.params, code, p)) / (2.0 * h);
                code[j] = c.code[j];
                error = fmax(error, fabs((double)d_code[j] - expected));
                size = fmax(size, fabs(expected));
            }
        }
        MODEL_CHECK(error <= 1e-4 * size, c.name, "largest error of a code gradient", 1e-4 * size, error);
        MODEL_CHECK(10 * excluded <= POINTS, c.name, "points near kinks", POINTS / 10.0, excluded);
        case_close(&c);
    }
}

TEST(what_the_file_says_of_code_channels_bound_and_clamp_is_what_the_net_tells)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        if (!case_open(&c, k)) continue;
        const model_desc *d = &c.m.desc;
        CHECK_EQUAL(d->code_size, dist_net_code_size(c.net));
        CHECK_EQUAL(d->code_count, dist_net_code_count(c.net));
        CHECK_EQUAL(c.m.channels, dist_net_channels(c.net));
        CHECK_NEAR(d->bound > 0.0 ? d->bound : 1.0, dist_net_bound(c.net), 1e-7);
        CHECK_NEAR(d->bound > 0.0 ? d->bound : 1.0, c.field.radius, 1e-7);
        CHECK_NEAR(d->clamp > 0.0 ? d->clamp : d->code_size ? 0.1 : 0.0, c.field.clamp, 1e-7);
        CHECK_EQUAL(d->code_size, c.field.code_size);
        CHECK_EQUAL(c.m.count, dist_net_weight_count(c.net));
        CHECK_EQUAL(c.m.count, c.field.weight_count);
        CHECK((c.field.color_fn != NULL) == (d->channels && strstr(d->channels, "r,g,b") != NULL));
        CHECK((c.field.eval_fn != NULL) == (c.m.sdf_channel >= 0));
        for (int i = 0; i < d->code_count * d->code_size; i++)
            CHECK_NEAR(c.m.codes[i], dist_net_code(c.net, i / d->code_size)[i % d->code_size], 0.0);
        CHECK(dist_net_code(c.net, d->code_count) == NULL && dist_net_code(c.net, -1) == NULL);
        const float *weights = dist_net_weights(c.net);
        for (size_t i = 0; i < c.m.count; i++) CHECK_NEAR(c.m.params[i], weights[i], d->spelling ? 1e-6 : 0.0);
        case_close(&c);
    }
}

TEST(color_is_the_three_channels_behind_one_another)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        float channels[4 * POINTS], color[3 * POINTS];
        const char *names = model_cases[k].channels, *first = names ? strstr(names, "r,g,b") : NULL;
        if (!first) continue;
        if (!case_open(&c, k)) continue;
        size_t at = first == names ? 0 : 1;
        dist_shape_eval(c.ctx, c.shape, POINTS, c.points, channels);
        c.field.color_fn(c.field.user, 0, POINTS, c.points, color);
        for (size_t i = 0; i < POINTS; i++)
            CHECK_BYTES(3 * sizeof(float), channels + i * (size_t)c.m.channels + at, color + 3 * i);
        case_close(&c);
    }
}

/* ---- folding, batches, dead units -------------------------------------------------------------------------------- */

TEST(a_code_folded_by_hand_gives_the_same_values)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        model folded;
        model_desc desc = model_cases[k];
        float a[4 * POINTS], b[4 * POINTS];
        if (desc.code_size == 0) continue;
        if (!case_open(&c, k)) continue;
        desc.code_size = desc.code_count = 0;
        desc.spelling = desc.dtype = 0;
        desc.clamp = 0.1;
        folded = model_make(&desc, 1);
        for (int l = 0; l < c.m.layers; l++) { /* copy all columns but the code's, which go to the bias */
            int in = c.m.in[l], small = folded.in[l], sees = model_sees_input(&c.m, l);
            int before = l && !desc.skip_input_first ? c.m.out[l - 1] : 0;
            int first = before + (desc.point_first ? c.m.point_size : 0);
            double scale = l && desc.skip_scale > 0.0 ? desc.skip_scale : 1.0;
            const double *from = c.m.params + c.m.offset[l];
            double *to = folded.params + folded.offset[l];
            memcpy(to + small * c.m.out[l], from + in * c.m.out[l],
                   (size_t)c.m.out[l] * (model_is_normed(&c.m, l) ? 3u : 1u) * sizeof(double));
            for (int o = 0; o < c.m.out[l]; o++) {
                double sum = 0.0;
                for (int j = 0, at = 0; j < in; j++) {
                    int is_code = sees && j >= first && j < first + c.m.desc.code_size;
                    if (is_code)
                        sum += scale * from[o * in + j] * c.code[j - first];
                    else
                        to[o * small + at++] = from[o * in + j];
                }
                to[small * c.m.out[l] + o] += sum;
            }
        }
        dist_net *net = model_load(c.ctx, &folded);
        dist_shape *shape = dist_shape_create(c.ctx, net, NULL);
        CHECK_STATUS(DIST_OK, dist_shape_eval(c.ctx, c.shape, POINTS, c.points, a), c.ctx);
        CHECK_STATUS(DIST_OK, dist_shape_eval(c.ctx, shape, POINTS, c.points, b), c.ctx);
        CHECK_NEAR_ARRAY((size_t)(POINTS * c.m.channels), b, a, 1e-6);
        CHECK_EQUAL(dist_net_operations(net, 0), dist_net_operations(c.net, 1));
        CHECK(dist_net_operations(c.net, 0) > dist_net_operations(c.net, 1));
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        model_free(&folded);
        case_close(&c);
    }
}

TEST(setting_a_code_equals_making_the_shape_with_it)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        float a[4 * POINTS], b[4 * POINTS];
        if (model_cases[k].code_size == 0) continue;
        if (!case_open(&c, k)) continue;
        dist_shape *shape = dist_shape_create(c.ctx, c.net, NULL);
        dist_shape_eval(c.ctx, c.shape, POINTS, c.points, a);
        CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, c.codef), c.ctx);
        dist_shape_eval(c.ctx, shape, POINTS, c.points, b);
        CHECK_BYTES((size_t)(POINTS * c.m.channels) * sizeof(float), a, b);
        dist_shape_destroy(shape);
        case_close(&c);
    }
}

TEST(operations_of_a_net_are_its_multiply_adds)
{
    model_desc desc = {.hidden = 2, .width = 10, .skip = 4, .code_size = 4};
    model m = model_make(&desc, 3);
    dist_context *ctx = test_context();
    dist_net *net = model_load(ctx, &m);
    /* 7 -> 10 -> 13 -> 1, the input again in front of the last */
    CHECK_EQUAL(10 * 7 + 13 * 10 + (13 + 7), dist_net_operations(net, 0));
    CHECK_EQUAL(10 * 3 + 13 * 10 + (13 + 3), dist_net_operations(net, 1));
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    model_free(&m);
}

/* Whether the compiler may compute LayerNorm of few points in another order, or in wider registers. */
#if defined __FAST_MATH__ || (defined __FLT_EVAL_METHOD__ && __FLT_EVAL_METHOD__ != 0 && __FLT_EVAL_METHOD__ != 16)
enum { LOOSE = 1 };
#else
enum { LOOSE = 0 };
#endif

static int same_values(size_t n, const float *a, const float *b, int normed)
{
    if (!LOOSE || !normed) return memcmp(a, b, n * sizeof(float)) == 0;
    int same = 1;
    for (size_t i = 0; i < n; i++) same &= fabsf(a[i] - b[i]) < 2e-5f;
    return same;
}

/* Gradients of n points, few enough to be one piece: those of up to three come with tangents, not by a reverse pass,
   and are the same to rounding. */
static int same_slopes(size_t n, const float *a, const float *b)
{
    int same = 1;
    if (n > 3) return memcmp(a, b, 3 * n * sizeof(float)) == 0;
    for (size_t i = 0; i < 3 * n; i++) {
        const float *g = a + i / 3 * 3;
        same &= fabsf(a[i] - b[i]) <= 8e-6f * (fabsf(g[0]) + fabsf(g[1]) + fabsf(g[2]));
    }
    return same;
}

TEST(a_point_has_the_same_bits_in_every_batch)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        enum { MOST = 100 };
        net_case c;
        float points[3 * MOST], sdf[MOST], gradient[3 * MOST], a[MOST], g[3 * MOST];
        if (model_cases[k].channels) continue;
        if (!case_open(&c, k)) continue;
        test_random random = test_random_seed(5);
        test_random_fill(&random, 3 * MOST, points, -1.0f, 1.0f);
        dist_field_eval(c.ctx, &c.field, MOST, points, sdf, gradient);
        for (size_t n = 1; n <= MOST; n += test_quick() ? 7 : 1) {
            size_t first = n * 37 % (MOST + 1 - n); /* another place in the block, too */
            dist_field_eval(c.ctx, &c.field, n, points + 3 * first, a, n % 3 ? g : NULL);
            MODEL_CHECK(same_values(n, sdf + first, a, model_cases[k].normed), c.name, "same values in a batch of", 0,
                        (double)n);
            if (n % 3)
                MODEL_CHECK(same_slopes(n, gradient + 3 * first, g), c.name, "same gradients in a batch of", 0,
                            (double)n);
        }
        case_close(&c);
    }
}

/* Where tangents overflow before the output's slope, which is 0 or next to it, brings them back: as of more points. */
TEST(gradients_of_lone_points_are_finite_where_those_of_others_are)
{
    enum { N = 40 };
    const model_desc descs[] = {{.name = "sine", .activation = DIST_ACTIVATION_SINE, .scale = 30, .first_scale = 30},
                                {.name = "relu"}};
    int tiny = 0;
    for (int k = 0; k < 2; k++) {
        dist_context *ctx = test_context();
        model m = model_make(&descs[k], 3);
        for (size_t i = 0; i < m.count; i++) m.params[i] *= 1e12;
        dist_net *net = model_load(ctx, &m);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        REQUIRE(shape != NULL);
        dist_field field = dist_shape_field(shape);
        float points[3 * N], sdf[N], f, slopes[3 * N], slope[3];
        test_random random = test_random_seed(5);
        test_random_fill(&random, 3 * N, points, -0.9f, 0.9f);
        field.eval_fn(field.user, 0, N, points, sdf, slopes);
        for (int i = 0; i < N; i++) {
            field.eval_fn(field.user, 0, 1, points + 3 * i, &f, slope);
            int block = 1, lone = 1;
            for (int a = 0; a < 3; a++) {
                block &= test_finite((double)slopes[3 * i + a]);
                lone &= test_finite((double)slope[a]);
            }
            tiny += block;
            CHECK(lone >= block);
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        model_free(&m);
        dist_context_destroy(ctx);
    }
    CHECK(tiny > 0);
}

/* f = one row of the encoded point: of the last of sixteen levels, whose angle is 2^15 times the first one's, too. */
TEST(every_level_of_an_encoded_point_has_a_floats_digits)
{
    enum { LEVELS = 16, N = 200, POINT = 3 + 6 * LEVELS };
    static float points[3 * N], sdf[N], gradient[3 * N], weights[POINT + 3];
    dist_context *ctx = test_context();
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 1;
    desc.width = 1;
    desc.levels = LEVELS;
    desc.activation = DIST_ACTIVATION_NONE;
    desc.output_linear = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    REQUIRE(net && dist_net_weight_count(net) == POINT + 3);
    test_random random = test_random_seed(8);
    test_random_fill(&random, 3 * N, points, -1.0f, 1.0f);
    double worst = 0;
    for (int row = 3; row < POINT; row++) { /* sin and cos of x, y, z, level by level */
        int level = (row - 3) / 6, axis = (row - 3) % 3, cosine = (row - 3) / 3 % 2;
        memset(weights, 0, sizeof weights);
        weights[row] = weights[POINT + 1] = 1;
        CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, weights), ctx);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        dist_field field = dist_shape_field(shape);
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, N, points, sdf, gradient), ctx);
        for (int i = 0; i < N; i++) {
            double base = ldexp(3.14159265358979323846, level), angle = base * (double)points[3 * i + axis];
            worst = fmax(worst, fabs((double)sdf[i] - (cosine ? cos(angle) : sin(angle))));
            double slope = (double)gradient[3 * i + axis] / base;
            worst = fmax(worst, fabs(slope - (cosine ? -sin(angle) : cos(angle))));
        }
        dist_shape_destroy(shape);
    }
    if (test_state.verbose) printf("    worst %.3g\n", worst);
    CHECK(worst < 1.3e-7);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* LayerNorm takes out how large a layer's sums are, also where their squares are beyond a float. */
TEST(a_layer_norm_of_sums_of_any_size_is_the_same)
{
    enum { MOST = 60 };
    float points[3 * MOST], sdf[5][MOST], slope[5][3 * MOST], few[MOST], slopes[3 * MOST];
    test_random random = test_random_seed(4);
    test_random_fill(&random, 3 * MOST, points, -1.0f, 1.0f);
    for (int activation = 0; activation < 2; activation++) {
        for (int k = 0; k < 5; k++) {
            const double scales[5] = {1e10, 1e18, 3e19, 1e24, 1e30};
            model_desc desc = {.hidden = 3, .width = 37, .normed = 1};
            desc.activation = activation ? DIST_ACTIVATION_SOFTPLUS : DIST_ACTIVATION_RELU;
            desc.first_scale = desc.scale = activation ? 10 : 0;
            model m = model_make(&desc, 3);
            size_t inner = (size_t)(m.in[0] + 1) * (size_t)m.out[0];
            for (size_t i = 0; i < inner; i++) m.params[m.offset[0] + i] *= scales[k];
            dist_context *ctx = test_context();
            dist_net *net = model_load(ctx, &m);
            dist_shape *shape = dist_shape_create(ctx, net, NULL);
            dist_field field = dist_shape_field(shape);
            CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, MOST, points, sdf[k], slope[k]), ctx);
            for (int i = 0; i < MOST; i++) {
                double p[3] = {(double)points[3 * i], (double)points[3 * i + 1], (double)points[3 * i + 2]};
                CHECK_NEAR(model_eval(&m, m.params, m.codes, p), sdf[k][i], 2e-5);
                for (int j = 0; j < 3; j++) CHECK_NEAR(slope[0][3 * i + j], slope[k][3 * i + j], 1e-3);
            }
            for (size_t n = 1; n < 14; n += 3) {
                CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, n, points, few, NULL), ctx);
                CHECK(same_values(n, sdf[k], few, 1));
                CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, n, points, few, slopes), ctx);
                for (size_t i = 0; i < 3 * n; i++) CHECK_NEAR(slope[0][i], slopes[i], 1e-3);
            }
            dist_shape_destroy(shape);
            dist_net_destroy(net);
            dist_context_destroy(ctx);
            model_free(&m);
        }
    }
}

TEST(a_dead_unit_that_is_left_out_changes_no_bit)
{
    for (int normed = 0; normed < 2; normed++) {
        model_desc desc = {.hidden = 4, .width = 40, .skip = 4, .code_size = 3, .normed = normed};
        model dead = model_make(&desc, 11), alive = model_make(&desc, 11);
        dist_context *ctx = test_context();
        float points[3 * POINTS], sdf[2][POINTS], gradient[2][3 * POINTS];
        test_random random = test_random_seed(2);
        test_random_fill(&random, 3 * POINTS, points, -1.0f, 1.0f);
        for (int l = 0; l + 1 < dead.layers; l++) {
            size_t in = (size_t)dead.in[l], out = (size_t)dead.out[l], next = (size_t)dead.in[l + 1];
            double *bias[2] = {dead.params + dead.offset[l] + in * out, alive.params + alive.offset[l] + in * out};
            for (size_t o = 0; o < out; o++) {
                if (test_random_int(&random, 0, 2) > 0) continue;
                /* one never fires; the other does, and nobody listens: gamma 0 makes both the same with a norm */
                for (int i = 0; i < 2; i++) {
                    if (normed) bias[i][out + o] = 0.0;
                    bias[i][(normed ? 2 * out : 0) + o] = i ? 9.0 : -9.0;
                }
                for (size_t u = 0; u < (size_t)alive.out[l + 1]; u++)
                    alive.params[alive.offset[l + 1] + u * next + o] = 0.0;
            }
        }
        double done[2] = {0, 0};
        for (int i = 0; i < 2; i++) {
            dist_net *net = model_load(ctx, i ? &alive : &dead);
            dist_shape *shape = dist_shape_create(ctx, net, NULL);
            dist_field field = dist_shape_field(shape);
            float eye[3] = {0, 0, 3}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
            dist_camera camera = dist_camera_look_at(8, 8, 0.6f, eye, at, up);
            dist_images out;
            dist_stats stats;
            CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, POINTS, points, sdf[i], gradient[i]), ctx);
            memset(&out, 0, sizeof out);
            memset(&stats, 0, sizeof stats);
            out.stats = &stats;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
            done[i] = stats.operations > 0.0 ? stats.operations_done / stats.operations : -1.0;
            dist_shape_destroy(shape);
            dist_net_destroy(net);
        }
        if (normed) { /* the norm sees the biased units: with gamma 0 only their outputs differ */
            CHECK_BYTES(sizeof sdf[0], sdf[1], sdf[0]);
        } else {
            CHECK_BYTES(sizeof sdf[0], sdf[1], sdf[0]);
            CHECK_BYTES(sizeof gradient[0], gradient[1], gradient[0]);
        }
        CHECK(done[0] > 0.0 && done[0] < 0.95 * done[1]);
        model_free(&dead);
        model_free(&alive);
        dist_context_destroy(ctx);
    }
}

static void unit_seed(void *user, size_t first, size_t n, const float *sdf, const float *gradient, float *seed)
{
    (void)user;
    (void)first;
    (void)sdf;
    (void)gradient;
    for (size_t i = 0; i < n; i++) seed[i] = 1.0f;
}

static double largest_difference(size_t n, const float *a, const float *b)
{
    double most = 0;
    for (size_t i = 0; i < n; i++) {
        double off = fabs((double)a[i] - (double)b[i]);
        most = off > most ? off : most;
    }
    return most;
}

/* A wide net's units stand in the kernels in the order of how often they are alive. Values and gradients, the weights'
   in the file's order, are those of the same net as it stands in the file. */
TEST(the_order_of_units_in_memory_does_not_show)
{
    enum { N = 100 };
    model_desc desc = {.hidden = 3, .width = 390, .skip = 4, .code_size = 3, .code_count = 2};
    dist_context *ctx = test_context();
    model m = model_make(&desc, 5);
    enum { WEIGHTS = 400000 };
    static float d_weights[2][WEIGHTS];
    float points[3 * N], u[3 * N], sdf[2][N], gradient[2][3 * N], d_sdf[N], d_points[3 * N];
    double d_code[2][3];
    test_random random = test_random_seed(4);
    test_random_fill(&random, 3 * N, points, -0.8f, 0.8f);
    test_random_fill(&random, 3 * N, u, -1.0f, 1.0f);
    for (int mode = 0; mode < 2; mode++) {
        dist_net *net = model_load(ctx, &m);
        int moved = 0;
        REQUIRE(net != NULL);
        for (int l = 0; l < desc.hidden; l++) {
            char seen[512] = {0};
            const int *unit, *place;
            int count = inside_units(net, l, &unit, &place);
            REQUIRE(unit != NULL && count > 0 && count <= 512);
            for (int i = 0; i < count; i++) {
                REQUIRE(unit[i] >= 0 && unit[i] < count && !seen[unit[i]]);
                seen[unit[i]] = 1;
                moved += unit[i] != i;
                CHECK_EQUAL(i, place[unit[i]]);
            }
        }
        CHECK(moved > 100);
        if (mode) inside_units_in_order(net);
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 1));
        dist_field field = dist_shape_field(shape);
        REQUIRE(field.weight_count <= WEIGHTS);
        memset(d_code[mode], 0, sizeof d_code[mode]);
        memset(d_points, 0, sizeof d_points);
        for (int i = 0; i < N; i++) d_sdf[i] = 1.0f;
        field.fused_fn(field.user, 0, N, points, sdf[mode], gradient[mode], unit_seed, NULL, d_code[mode]);
        CHECK_STATUS(DIST_OK, field.weights_fn(field.user, ctx, N, points, d_sdf, unit_seed, NULL, d_points,
                                               d_code[mode], d_weights[mode]), ctx);
        CHECK_STATUS(DIST_OK, field.second_weights_fn(field.user, ctx, N, points, u, d_points, d_code[mode],
                                                       d_weights[mode]),
                     ctx);
        if (mode) {
            CHECK_NEAR(0, largest_difference(N, sdf[0], sdf[1]), 2e-6);
            CHECK_NEAR(0, largest_difference(3 * N, gradient[0], gradient[1]), 1e-5);
            for (int k = 0; k < 3; k++) CHECK_NEAR(d_code[1][k], d_code[0][k], 1e-4);
            CHECK_NEAR(0, largest_difference(field.weight_count, d_weights[0], d_weights[1]), 2e-4);
            double size = 0;
            for (size_t i = 0; i < field.weight_count; i++) size += fabs((double)d_weights[1][i]);
            CHECK(size > 10);
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    model_free(&m);
    dist_context_destroy(ctx);
}

/* Few points go through kernels of their own, without LayerNorm on the way to gradients, too: the bits are those of a
   full block, but of the gradients of up to three. */
TEST(a_few_points_have_the_bits_of_many)
{
    enum { MANY = 48 };
    const model_desc descs[] = {{.hidden = 4, .width = 131, .skip = 2, .code_size = 3},
                                {.hidden = 7, .width = 147, .skip = 3, .code_size = 3}, /* in parts: disti_net_part */
                                {.hidden = 2, .width = 20},
                                {.hidden = 3, .width = 33, .fourier = 1, .levels = 3},
                                {.hidden = 1, .width = 9},
                                {.hidden = 3, .width = 108, .skip = 2, .normed = 1},
                                {.hidden = 3, .width = 53, .normed = 1, .activation = DIST_ACTIVATION_SOFTPLUS},
                                {.hidden = 4, .width = 70, .skip = 2, .activation = DIST_ACTIVATION_SOFTPLUS},
                                {.hidden = 3, .width = 41, .activation = DIST_ACTIVATION_SINE, .scale = 5},
                                {.hidden = 2, .width = 24, .activation = DIST_ACTIVATION_ELU},
                                {.hidden = 2, .width = 40, .activation = DIST_ACTIVATION_TANH}};
    for (int i = 0; i < (int)(sizeof descs / sizeof descs[0]); i++) {
        dist_context *ctx = test_context();
        model m = model_make(&descs[i], 11);
        dist_net *net = model_load(ctx, &m);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        REQUIRE(shape != NULL);
        dist_field field = dist_shape_field(shape);
        float points[3 * MANY], many[MANY], few[MANY], slope[3 * MANY], slopes[3 * MANY];
        test_random random = test_random_seed(7);
        test_random_fill(&random, 3 * MANY, points, -0.9f, 0.9f);
        field.eval_fn(field.user, 0, MANY, points, many, slopes);
        for (int n = 1; n <= MANY; n++) {
            for (int at = 0; at + n <= MANY; at += n) {
                inside_soil(ctx, 0);
                field.eval_fn(field.user, 0, (size_t)n, points + 3 * at, few, NULL);
                CHECK(same_values((size_t)n, many + at, few, descs[i].normed));
                inside_soil(ctx, n & 1 ? 0 : 0xff);
                field.eval_fn(field.user, 0, (size_t)n, points + 3 * at, few, slope);
                CHECK(same_values((size_t)n, many + at, few, descs[i].normed));
                CHECK(same_slopes((size_t)n, slopes + 3 * at, slope));
            }
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        model_free(&m);
        dist_context_destroy(ctx);
    }
}

/* Units that a bound proves dead over a block of neighbors are not computed: the bits are those of any one point. */
TEST(rows_that_are_left_out_change_no_bit)
{
    enum { MANY = 2111 };
    static float points[3 * MANY], sdf[3][MANY], gradient[2][3 * MANY];
    static double d_code[2][256];
    for (int from = 0; from < 3; from++) { /* a net whose points stay as they are, and two of neighbors first */
        model_desc desc = {.hidden = 5, .width = from ? 171 : 131, .skip = 3, .code_size = 2};
        dist_context *ctx = test_context();
        model m = model_make(&desc, 5);
        dist_net *net = from > 1 ? dist_net_load_file(ctx, "../shared/data/nets/deepsdf_512.safetensors")
                                 : model_load(ctx, &m);
        model_free(&m);
        if (!net) { /* without the data */
            dist_context_destroy(ctx);
            continue;
        }
        dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 0));
        dist_field field = dist_shape_field(shape);
        test_random random = test_random_seed(3);
        float spread[3] = {0.02f, 0.4f, 0.1f}; /* near each other, a sheet, and in between */
        size_t less = !test_quick() ? 1 : from > 1 ? 4 : 2;
        double done[3] = {0, 0, 0};
        CHECK(inside_groups(shape, 2) == 2 || from < 2); /* memory for them has every net that is wide enough */
        for (int round = 0; round < 3; round++) {
            test_random_fill(&random, 3 * MANY, points, -spread[round], spread[round]);
            for (int i = 0; i < MANY && round == 1; i++) points[3 * i] = 0.3f;
            size_t n = (round == 2 ? MANY : MANY / 2) / less;
            for (int mode = 0; mode < 3; mode++) { /* groups, blocks, one by one */
                inside_done(ctx);
                inside_groups(shape, mode == 0 ? 2 : 0);
                for (size_t i = 0; i < n; i += mode == 2 ? 1 : n)
                    field.eval_fn(field.user, 0, mode == 2 ? 1 : n, points + 3 * i, sdf[mode] + i, NULL);
                done[mode] += inside_done(ctx);
            }
            CHECK_BYTES(n * sizeof(float), sdf[1], sdf[0]);
            CHECK_BYTES(n * sizeof(float), sdf[2], sdf[0]);
            for (int mode = 0; mode < 2; mode++) { /* and with the reverse pass */
                memset(d_code[mode], 0, sizeof d_code[mode]);
                inside_groups(shape, mode == 0 ? 2 : 0);
                field.fused_fn(field.user, 0, n, points, sdf[mode], gradient[mode], unit_seed, NULL, d_code[mode]);
            }
            CHECK_BYTES(n * sizeof(float), sdf[1], sdf[0]);
            CHECK_BYTES(n * sizeof(float), sdf[2], sdf[0]);
            CHECK_BYTES(3 * n * sizeof(float), gradient[1], gradient[0]);
            CHECK_BYTES((size_t)dist_net_code_size(net) * sizeof(double), d_code[1], d_code[0]);
            CHECK(d_code[0][0] != 0);
        }
        int worse = 0; /* points that are not finite are no others' business */
        for (int i = 0; i < MANY; i += 7) points[3 * i + i % 3] = i % 2 ? NAN : INFINITY;
        inside_groups(shape, 2);
        field.eval_fn(field.user, 0, MANY / less, points, sdf[0], NULL);
        for (size_t i = 0; i < MANY / less; i++) {
            if (i % 7 == 0) continue;
            field.eval_fn(field.user, 0, 1, points + 3 * i, sdf[1], NULL);
            worse += memcmp(sdf[1], sdf[0] + i, sizeof(float)) != 0;
        }
        CHECK_EQUAL(0, worse);
        CHECK(inside_is_wide(shape) == (from > 0));
        CHECK(done[0] < (from ? 0.8 : 0.95) * done[1]);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

/* ---- saving ------------------------------------------------------------------------------------------------------ */

static unsigned char *saved(dist_context *ctx, const dist_net *net, size_t *size)
{
    unsigned char *bytes = NULL;
    if (CHECK_STATUS(DIST_OK, dist_net_save(ctx, net, NULL, 0, size), ctx)) bytes = (unsigned char *)malloc(*size);
    if (bytes) CHECK_STATUS(DIST_OK, dist_net_save(ctx, net, bytes, *size, size), ctx);
    return bytes;
}

TEST(a_saved_net_loads_and_saves_to_the_same_bytes_and_values)
{
    for (int k = 0; k < MODEL_CASES; k++) {
        net_case c;
        size_t size[2];
        float a[4 * POINTS], b[4 * POINTS];
        if (!case_open(&c, k)) continue;
        unsigned char *first = saved(c.ctx, c.net, &size[0]);
        dist_net *net = first ? dist_net_load(c.ctx, first, size[0]) : NULL;
        dist_shape *shape = dist_shape_create(c.ctx, net, c.codef);
        unsigned char *second = net ? saved(c.ctx, net, &size[1]) : NULL;
        MODEL_CHECK(shape && second && size[0] == size[1] && memcmp(first, second, size[0]) == 0, c.name,
                    dist_context_message(c.ctx), 0, 0);
        if (shape) {
            dist_shape_eval(c.ctx, c.shape, POINTS, c.points, a);
            dist_shape_eval(c.ctx, shape, POINTS, c.points, b);
            MODEL_CHECK(memcmp(a, b, (size_t)(POINTS * c.m.channels) * sizeof(float)) == 0, c.name, "same values", 0,
                        0);
            dist_field field = dist_shape_field(shape);
            CHECK_NEAR(c.field.clamp, field.clamp, 0.0);
            CHECK_NEAR(c.field.radius, field.radius, 0.0);
            CHECK_EQUAL(dist_net_code_count(c.net), dist_net_code_count(net));
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        free(first);
        free(second);
        case_close(&c);
    }
}

TEST(saving_into_too_small_a_buffer_is_refused)
{
    net_case c;
    size_t size = 0, again = 0;
    REQUIRE(case_open(&c, 0));
    unsigned char *bytes = saved(c.ctx, c.net, &size);
    REQUIRE(bytes != NULL);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_save(c.ctx, c.net, bytes, size - 1, &again), c.ctx);
    CHECK_EQUAL(size, again);
    free(bytes);
    case_close(&c);
}

TEST(a_file_that_takes_nothing_is_told_of)
{
    net_case c;
    FILE *full = fopen("/dev/full", "rb");
    if (!full) SKIP("there is no /dev/full");
    fclose(full);
    REQUIRE(case_open(&c, 11));
    CHECK_STATUS(DIST_IO, dist_net_save_file(c.ctx, c.net, "/dev/full"), c.ctx);
    CHECK_TEXT("dist_net_save_file", dist_context_message(c.ctx));
    CHECK_TEXT("/dev/full", dist_context_message(c.ctx));
    dist_context_clear(c.ctx);
    CHECK(dist_net_load_file(c.ctx, "/dev") == NULL); /* a folder */
    CHECK_STATUS(DIST_IO, dist_context_status(c.ctx), c.ctx);
    CHECK_TEXT("/dev", dist_context_message(c.ctx));
    case_close(&c);
}

TEST(a_net_saved_to_a_file_is_loaded_from_it)
{
    net_case c;
    size_t size[2];
    REQUIRE(case_open(&c, 11));
    const char *path = test_temp_path("test_net.safetensors");
    if (dist_net_save_file(c.ctx, c.net, path) == DIST_IO) {
        case_close(&c);
        SKIP("the folder for temporary files is not there");
    }
    dist_net *net = dist_net_load_file(c.ctx, path);
    CHECK_STATUS(DIST_OK, dist_context_status(c.ctx), c.ctx);
    unsigned char *a = saved(c.ctx, c.net, &size[0]), *b = saved(c.ctx, net, &size[1]);
    REQUIRE(a && b);
    CHECK_EQUAL(size[0], size[1]);
    CHECK_BYTES(size[0], a, b);
    remove(path);
    CHECK(dist_net_load_file(c.ctx, path) == NULL);
    CHECK_STATUS(DIST_IO, dist_context_status(c.ctx), c.ctx);
    free(a);
    free(b);
    dist_net_destroy(net);
    case_close(&c);
}

/* ---- making ------------------------------------------------------------------------------------------------------ */

static dist_net_desc small_desc(void)
{
    dist_net_desc d;
    memset(&d, 0, sizeof d);
    d.layers = 4;
    d.width = 48;
    d.skip = 2;
    d.code_size = 5;
    d.code_count = 3;
    return d;
}

/* The mean and the largest deviation from it of f at |p| = r. */
static double sphere_mean(dist_context *ctx, const dist_field *field, double r, double *deviation)
{
    enum { N = 200 };
    float points[3 * N], sdf[N];
    double mean = 0.0;
    test_random random = test_random_seed(1);
    for (int i = 0; i < N; i++) {
        test_random_direction(&random, points + 3 * i);
        for (int k = 0; k < 3; k++) points[3 * i + k] *= (float)r;
    }
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, field, N, points, sdf, NULL), ctx);
    for (int i = 0; i < N; i++) mean += (double)sdf[i] / N;
    *deviation = 0.0;
    for (int i = 0; i < N; i++) *deviation = fmax(*deviation, fabs((double)sdf[i] - mean));
    return mean;
}

/* A plain net of dist_net_create, in double. */
static double plain_eval(const dist_net_desc *d, const float *weights, const double p[3])
{
    double x[64], y[64];
    int in = 3;
    memcpy(x, p, 3 * sizeof(double));
    for (int l = 0; l <= d->layers; l++) {
        int out = l == d->layers ? 1 : d->width;
        const float *bias = weights + out * in;
        for (int o = 0; o < out; o++) {
            y[o] = (double)bias[o];
            for (int k = 0; k < in; k++) y[o] += (double)weights[o * in + k] * x[k];
            if (l == d->layers) continue;
            if (d->activation == DIST_ACTIVATION_SOFTPLUS) y[o] = fmax(y[o], 0) + log1p(exp(-100 * fabs(y[o]))) / 100;
            if (d->activation == DIST_ACTIVATION_RELU) y[o] = fmax(y[o], 0);
            if (d->activation == DIST_ACTIVATION_SINE) y[o] = sin(5 * y[o]);
            if (d->activation == DIST_ACTIVATION_TANH) y[o] = tanh(y[o]);
        }
        weights = bias + out;
        in = out;
        memcpy(x, y, sizeof x);
    }
    return x[0];
}

/* A small net rounds by the size of its hidden values, which is that of 1, not of its bound: field.noise says so, and
   hits are as near as they say. (But for a few: where such an f is flat its noise goes a long way.) */
TEST(a_small_net_says_how_it_rounds)
{
    enum { RAYS = 300 };
    static const int activations[4] = {DIST_ACTIVATION_RELU, DIST_ACTIVATION_SOFTPLUS, DIST_ACTIVATION_SINE,
                                       DIST_ACTIVATION_TANH};
    static float from[3 * RAYS], to[3 * RAYS];
    static dist_hit hits[RAYS];
    dist_context *ctx = test_context();
    test_random r = test_random_seed(31);
    int before = 0, after = 0;
    for (int k = 0; k < 16; k++) {
        dist_net_desc d;
        double bound = pow(10, -(k / 4)), worst = 0;
        int found = 0, off[2] = {0, 0};
        memset(&d, 0, sizeof d);
        d.layers = 3;
        d.width = 48;
        d.activation = activations[k % 4];
        d.geometric = k % 4 < 2;
        d.scale = k % 4 == 1 ? 100 : k % 4 == 2 ? 5 : 0;
        d.output_linear = 1;
        d.seed = (unsigned)k + 1;
        d.bound = (float)bound;
        dist_net *net = dist_net_create(ctx, &d);
        REQUIRE(net != NULL);
        size_t count = dist_net_weight_count(net);
        float *weights = (float *)malloc(count * sizeof(float));
        REQUIRE(weights != NULL);
        memcpy(weights, dist_net_weights(net), count * sizeof(float));
        if (!d.geometric) { /* a surface through the middle */
            const double middle[3] = {0.1 * bound, 0, 0};
            weights[count - 1] -= (float)plain_eval(&d, weights, middle);
            CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, weights), ctx);
        }
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        REQUIRE(shape != NULL);
        dist_field field = dist_shape_field(shape);
        for (int i = 0; i < RAYS; i++) {
            double p[3];
            float q[3], f;
            for (int j = 0; j < 3; j++) {
                p[j] = (double)(q[j] = (float)(bound * test_random_double(&r, -0.6, 0.6)));
                from[3 * i + j] = (float)(bound * test_random_double(&r, -1.5, 1.5));
                to[3 * i + j] = (float)(bound * test_random_double(&r, -0.5, 0.5)) - from[3 * i + j];
            }
            CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 1, q, &f, NULL), ctx);
            worst = fmax(worst, fabs((double)f - plain_eval(&d, weights, p)));
        }
        for (int told = 0; told < 2; told++) { /* what it would be without the figure, and with it */
            dist_field traced = field;
            traced.noise = told ? field.noise : 0.0f;
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &traced, RAYS, from, to, NULL, hits, NULL), ctx);
            for (int i = 0; i < RAYS; i++) {
                double length = 0, f[2], e = 1.01 * (double)hits[i].error + 3e-7 * bound;
                if (hits[i].status != DIST_RAY_HIT) continue;
                for (int j = 0; j < 3; j++) length += (double)to[3 * i + j] * (double)to[3 * i + j];
                for (int side = 0; side < 2; side++) {
                    double p[3], t = ((double)hits[i].distance + (side ? e : -e)) / sqrt(length);
                    for (int j = 0; j < 3; j++) p[j] = (double)from[3 * i + j] + t * (double)to[3 * i + j];
                    f[side] = plain_eval(&d, weights, p);
                }
                found += told;
                off[told] += f[0] * f[1] > 0;
            }
        }
        double figure = fmax(5e-7 * bound, (double)field.noise);
        if (test_state.verbose)
            printf("    bound %g, activation %d: f off by %.1e, figure %.1e; %d hits, %d beyond their error (%d)\n",
                   bound, d.activation, worst, figure, found, off[1], off[0]);
        CHECK(worst < 2 * figure);
        CHECK(figure < 30 * worst + 6e-7 * bound);
        CHECK(found > 60 && off[1] * 12 <= found);
        before += off[0];
        after += off[1];
        free(weights);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
    }
    CHECK(before > 20 && 4 * after <= before);
    dist_context_destroy(ctx);
}

TEST(a_geometric_start_is_near_the_distance_to_a_sphere_of_half_the_bound)
{
    static const struct start {
        int layers, width, activation, levels;
        float scale, bound;
        double least; /* f at the bound, less that at 0, in bounds */
    } starts[9] = {{4, 256, DIST_ACTIVATION_RELU, 0, 0, 1, 0.7},      {4, 256, DIST_ACTIVATION_RELU, 6, 0, 2, 0.7},
                   {4, 64, DIST_ACTIVATION_RELU, 0, 0, 1, 0.6},       {8, 512, DIST_ACTIVATION_RELU, 0, 0, 1, 0.7},
                   {4, 256, DIST_ACTIVATION_SOFTPLUS, 6, 0, 1, 0.5},  {4, 256, DIST_ACTIVATION_SOFTPLUS, 0, 0, 2, 0.6},
                   {8, 512, DIST_ACTIVATION_SOFTPLUS, 0, 0, 1, 0.4},  {8, 512, DIST_ACTIVATION_SOFTPLUS, 0, 30, 1, 0.1},
                   {8, 512, DIST_ACTIVATION_SOFTPLUS, 0, 100, 0.4f, 0.1}};
    for (int k = 0; k < 9; k++) {
        const struct start *start = &starts[k];
        if (test_quick() && start->width > 256) continue;
        double bound = (double)start->bound, half, all;
        dist_context *ctx = test_context();
        dist_net_desc d = small_desc();
        float code[5] = {1, -1, 0.5f, 2, 0}, zero[3] = {0, 0, 0}, inside;
        d.layers = start->layers;
        d.width = start->width;
        d.activation = start->activation;
        d.levels = start->levels;
        d.scale = start->scale;
        d.bound = start->bound;
        d.geometric = d.output_linear = 1;
        dist_net *net = dist_net_create(ctx, &d);
        dist_shape *shape = dist_shape_create(ctx, net, code);
        dist_field field = dist_shape_field(shape);
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 1, zero, &inside, NULL), ctx);
        double rise = sphere_mean(ctx, &field, bound, &all) - (double)inside;
        double middle = sphere_mean(ctx, &field, 0.5 * bound, &half);
        CHECK(rise > start->least * bound && rise < 1.3 * bound);
        CHECK((double)inside < -0.2 * rise);
        CHECK_NEAR(0.0, middle, 0.03 * rise); /* 16 of the sphere's points gave the bias */
        CHECK(half < 0.35 * rise && all < 0.45 * rise);
        CHECK_NEAR(bound, field.radius, 0.0);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

TEST(a_seed_gives_the_same_net_and_another_seed_another)
{
    dist_context *ctx = test_context();
    dist_net_desc d = small_desc();
    for (int geometric = 0; geometric < 2; geometric++) {
        d.geometric = geometric;
        d.seed = 5;
        dist_net *a = dist_net_create(ctx, &d), *b = dist_net_create(ctx, &d);
        d.seed = 6;
        dist_net *other = dist_net_create(ctx, &d);
        size_t n = dist_net_weight_count(a);
        REQUIRE(a && b && other);
        CHECK_BYTES(n * sizeof(float), dist_net_weights(a), dist_net_weights(b));
        CHECK(memcmp(dist_net_weights(a), dist_net_weights(other), n * sizeof(float)) != 0);
        int equal = 0; /* nor are one's numbers the other's, some draws later */
        for (int i = 0; i < 200; i++)
            for (int j = 0; j < 200; j++) {
                float x = dist_net_weights(a)[i], y = dist_net_weights(other)[j];
                equal += x == y && x != 0.0f;
            }
        CHECK(equal < 5);
        dist_net_destroy(a);
        dist_net_destroy(b);
        dist_net_destroy(other);
    }
    dist_context_destroy(ctx);
}

TEST(a_net_made_has_the_form_asked_for)
{
    dist_context *ctx = test_context();
    dist_net_desc d = small_desc();
    d.clamp = 0.25f;
    dist_net *net = dist_net_create(ctx, &d);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    CHECK_EQUAL(5, dist_net_code_size(net));
    CHECK_EQUAL(3, dist_net_code_count(net));
    CHECK_EQUAL(1, dist_net_channels(net));
    CHECK_EQUAL(9 * 48 + 49 * 48 + 57 * 48 + 49 * 48 + 49, dist_net_weight_count(net));
    CHECK_NEAR(0.25, dist_shape_field(shape).clamp, 1e-7);
    for (int i = 0; i < 15; i++) CHECK_NEAR(0.0, dist_net_code(net, i / 5)[i % 5], 0.0);
    /* PyTorch's start is uniform within 1 / sqrt(in) */
    float largest = 0.0f;
    for (int i = 0; i < 8 * 48; i++) largest = fmaxf(largest, fabsf(dist_net_weights(net)[i]));
    CHECK(largest <= 0.35356f && largest > 0.33f);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(a_net_that_cannot_be_made_is_refused)
{
    static const char *const says[] = {
        "layers is 32, must be 1 to 31", "width is 4097", "skip is 4", "skip is -1", "code_size is -1",
        "activation is 6", "scale is -1", "bound is -1", "bound is 1100000", "scale is 1100000",
        "clamp is 1100000, must be at most 1e6", "layers is -1", "geometric is 2, must be 0 to 1",
        "color is -3, must be 0 to 1", "output_linear is 2", "geometric is 1 with activation 3, must be 0"};
    for (int k = 0; k < (int)(sizeof says / sizeof says[0]); k++) {
        dist_context *ctx = test_context();
        dist_net_desc d = small_desc();
        switch (k) {
        case 0: d.layers = 32; break;
        case 1: d.width = 4097; break;
        case 2: d.skip = 4; break;
        case 3: d.skip = -1; break;
        case 4: d.code_size = -1; break;
        case 5: d.activation = 6; break;
        case 6: d.scale = -1.0f; break;
        case 7: d.bound = -1.0f; break;
        case 8: d.bound = 1.1e6f; break; /* what a file may not say: it could be saved, but not loaded */
        case 9: d.scale = 1.1e6f; break;
        case 10: d.clamp = 1.1e6f; break;
        case 11: d.layers = -1; break;
        case 12: d.geometric = 2; break;
        case 13: d.color = -3; break;
        case 14: d.output_linear = 2; break;
        default: d.geometric = 1, d.activation = DIST_ACTIVATION_SINE; break;
        }
        CHECK(dist_net_create(ctx, &d) == NULL);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
        CHECK_TEXT("dist_net_create: ", dist_context_message(ctx));
        CHECK_TEXT(says[k], dist_context_message(ctx));
        dist_context_destroy(ctx);
    }
}

TEST(set_weights_makes_one_net_the_other)
{
    dist_context *ctx = test_context();
    dist_net_desc d = small_desc();
    float a[POINTS], b[POINTS], points[3 * POINTS], code[5] = {0.5f, -1, 2, 0.25f, 1};
    test_random random = test_random_seed(4);
    test_random_fill(&random, 3 * POINTS, points, -1.0f, 1.0f);
    dist_net *net = dist_net_create(ctx, &d);
    d.seed = 9;
    dist_net *other = dist_net_create(ctx, &d);
    dist_shape *shape = dist_shape_create(ctx, net, code), *expected = dist_shape_create(ctx, other, code);
    CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, dist_net_weights(other)), ctx);
    CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, code), ctx);
    dist_shape_eval(ctx, shape, POINTS, points, a);
    dist_shape_eval(ctx, expected, POINTS, points, b);
    CHECK_BYTES(sizeof a, b, a);
    CHECK_STATUS(DIST_OK, dist_net_set_code(ctx, net, 2, code), ctx);
    CHECK_BYTES(sizeof code, code, dist_net_code(net, 2));
    for (int i = 0; i < 10; i++) CHECK_NEAR(0.0, dist_net_code(net, i / 5)[i % 5], 0.0);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_set_code(ctx, net, 3, code), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_set_code(ctx, net, -1, code), ctx);
    dist_shape_destroy(shape);
    dist_shape_destroy(expected);
    dist_net_destroy(net);
    dist_net_destroy(other);
    dist_context_destroy(ctx);
}

static float not_a_number(void)
{
    uint32_t bits = 0x7fc00000u;
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

TEST(numbers_that_are_not_finite_are_refused_and_change_nothing)
{
    dist_context *ctx = test_context();
    dist_net_desc d = small_desc();
    dist_net *net = dist_net_create(ctx, &d);
    size_t n = dist_net_weight_count(net);
    float *weights = (float *)malloc(n * sizeof(float)), code[5] = {0}, before, after, p[3] = {0.1f, 0.2f, 0.3f};
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    REQUIRE(weights && shape);
    dist_shape_eval(ctx, shape, 1, p, &before);
    memcpy(weights, dist_net_weights(net), n * sizeof(float));
    for (size_t i = 0; i + 1 < n; i++) weights[i] = 1.0f;
    weights[n - 1] = code[4] = not_a_number();
    CHECK_STATUS(DIST_NOT_FINITE, dist_net_set_weights(ctx, net, weights), ctx);
    CHECK_STATUS(DIST_NOT_FINITE, dist_net_set_code(ctx, net, 0, code), ctx);
    CHECK_STATUS(DIST_NOT_FINITE, dist_shape_set_code(shape, code), ctx);
    CHECK(dist_shape_create(ctx, net, code) == NULL);
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
    dist_shape_eval(ctx, shape, 1, p, &after);
    CHECK_BYTES(sizeof before, &before, &after);
    free(weights);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* ---- refusing ---------------------------------------------------------------------------------------------------- */

static const char *const good_tensors =
    "lin0.weight 4 5;lin0.bias 4;lin1.weight 4 4;lin1.bias 4;lin2.weight 1 4;lin2.bias 1;";

/* A file of these tensors, all its numbers 0.25 but the one at place `bad`, which is `value`. */
static unsigned char *file_of(const char *meta, const char *tensors, const char *type, int bad, float value,
                              size_t *size)
{
    static char header[8192];
    size_t at = 0, numbers = 0, length = 0, width = strcmp(type, "F32") == 0 ? 4 : strcmp(type, "F64") == 0 ? 8 : 2;
    length += (size_t)snprintf(header, sizeof header, "{\"__metadata__\":{%s}", meta);
    for (; tensors[at]; at++) {
        char name[64];
        long shape[2] = {1, 1};
        int rank = 0;
        size_t n = strcspn(tensors + at, " ");
        memcpy(name, tensors + at, n);
        name[n] = 0;
        for (at += n; tensors[at] == ' '; at += strcspn(tensors + at, " ;"))
            shape[rank++] = strtol(tensors + ++at, NULL, 10);
        size_t count = (size_t)(shape[0] * shape[1]);
        length += (size_t)snprintf(header + length, sizeof header - length,
                                   rank == 2 ? ",\"%s\":{\"dtype\":\"%s\",\"shape\":[%ld,%ld],"
                                             : ",\"%s\":{\"dtype\":\"%s\",\"shape\":[%ld],",
                                   name, type, shape[0], shape[1]);
        length += (size_t)snprintf(header + length, sizeof header - length, "\"data_offsets\":[%lu,%lu]}",
                                   (unsigned long)(numbers * width), (unsigned long)((numbers + count) * width));
        numbers += count;
    }
    length += (size_t)snprintf(header + length, sizeof header - length, "}");
    *size = 8 + length + numbers * width;
    unsigned char *bytes = (unsigned char *)calloc(1, *size);
    if (!bytes) exit(1);
    for (size_t i = 0; i < 8; i++) bytes[i] = (unsigned char)((uint64_t)length >> 8 * i);
    memcpy(bytes + 8, header, length);
    for (size_t i = 0; i < numbers && width == 4; i++) {
        float x = (int)i == bad ? value : 0.25f;
        memcpy(bytes + 8 + length + 4 * i, &x, sizeof x);
    }
    return bytes;
}

static void refused(dist_status expected, const char *part, const char *meta, const char *tensors, const char *type,
                    int bad, float value, const char *file, int line)
{
    test_allocator a;
    dist_context_desc desc = test_context_desc();
    size_t size;
    memset(&a, 0, sizeof a);
    desc.workers = 1;
    desc.allocator = test_allocator_hook(&a);
    dist_context *ctx = dist_context_create(&desc);
    size_t before = a.live_blocks;
    unsigned char *bytes = file_of(meta, tensors, type, bad, value, &size);
    dist_net *net = dist_net_load(ctx, bytes, size);
    model_check(net == NULL && dist_context_status(ctx) == expected && strstr(dist_context_message(ctx), part) &&
                    strncmp(dist_context_message(ctx), "dist_net_load: ", 15) == 0,
                meta[0] ? meta : tensors, dist_context_message(ctx), expected, dist_context_status(ctx), file, line);
    dist_net_destroy(net);
    free(bytes);
    CHECK_EQUAL(before, a.live_blocks);
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, a.live_blocks);
}

TEST(the_file_that_the_wrong_ones_are_made_of_is_right)
{
    dist_context *ctx = test_context();
    size_t size;
    unsigned char *bytes = file_of("", good_tensors, "F32", -1, 0.0f, &size);
    dist_net *net = dist_net_load(ctx, bytes, size);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    CHECK_EQUAL(2, dist_net_code_size(net));
    free(bytes);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

#define REFUSED(status, part, meta, tensors) refused(status, part, meta, tensors, "F32", -1, 0.0f, __FILE__, __LINE__)

/* The last value of the file's table of contents, so that a byte beyond it is a byte beyond a block of memory. */
TEST(channels_that_end_the_header_are_read_no_further)
{
    static const char *const channels[] = {"r", "sdf,r", "sdf,r,g", "r,g,b", "sdf,r,g,b", "rgb"};
    for (size_t k = 0; k < sizeof channels / sizeof channels[0]; k++) {
        char header[256];
        dist_context *ctx = test_context();
        size_t n = (size_t)snprintf(header, sizeof header,
                                    "{\"a\":{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]},"
                                    "\"__metadata__\":{\"dist.channels\":\"%s\"}}",
                                    channels[k]);
        unsigned char *bytes = (unsigned char *)calloc(1, 8 + n);
        if (!bytes) exit(1);
        bytes[0] = (unsigned char)n;
        memcpy(bytes + 8, header, n);
        CHECK(dist_net_load(ctx, bytes, 8 + n) == NULL);
        CHECK_STATUS(DIST_BAD_FILE, dist_context_status(ctx), ctx);
        free(bytes);
        dist_context_destroy(ctx);
    }
}

TEST(spaces_around_the_channels_names_are_none_of_theirs)
{
    static const char *const metas[] = {"\"dist.channels\":\"sdf,r,g,b\"", "\"dist.channels\":\" sdf , r,g ,b  \""};
    for (int k = 0; k < 2; k++) {
        dist_context *ctx = test_context();
        size_t size;
        unsigned char *bytes = file_of(metas[k], "lin0.weight 4 5;lin0.bias 4;lin1.weight 4 4;lin1.bias 4;", "F32", -1,
                                       0.0f, &size);
        dist_net *net = dist_net_load(ctx, bytes, size);
        CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        dist_field field = dist_shape_field(shape);
        CHECK_EQUAL(4, dist_net_channels(net));
        CHECK(field.eval_fn != NULL && field.color_fn != NULL);
        free(bytes);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
    REFUSED(DIST_BAD_FILE, "dist.channels", "\"dist.channels\":\"sdf, ,r\"", good_tensors);
}

/* Where nothing names them the first is the distance; saved, the others have names. */
TEST(channels_without_names_are_a_distance_and_more)
{
    dist_context *ctx = test_context();
    size_t size;
    unsigned char *bytes = file_of("", "lin0.weight 12 5;lin0.bias 12;", "F32", -1, 0.0f, &size);
    dist_net *net = dist_net_load(ctx, bytes, size);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    size_t saved;
    CHECK_STATUS(DIST_OK, dist_net_save(ctx, net, NULL, 0, &saved), ctx);
    unsigned char *again = (unsigned char *)malloc(saved + 1);
    REQUIRE(again != NULL);
    CHECK_STATUS(DIST_OK, dist_net_save(ctx, net, again, saved, &saved), ctx);
    again[saved] = 0;
    for (int k = 0; k < 2; k++) {
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        dist_field field = dist_shape_field(shape);
        CHECK_EQUAL(12, dist_net_channels(net));
        CHECK(field.eval_fn != NULL && field.color_fn == NULL);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        net = k ? NULL : dist_net_load(ctx, again, saved);
    }
    CHECK_TEXT("\"sdf,c1,c2,c3,c4,c5,c6,c7,c8,c9,c10,c11\"", (const char *)again + 8);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    free(bytes);
    free(again);
    dist_context_destroy(ctx);
}

/* 1e-6, the least that a bound and a scale may be, is no float: it is written as a number somewhat below. */
TEST(the_least_numbers_a_file_may_say_are_floats)
{
    static const char *const least[] = {
        "\"dist.bound\":\"9.99999997e-7\"", "\"dist.activation\":\"sine:9.99999997e-7\"",
        "\"dist.bound\":\"0.000001\"", "\"dist.activation\":\"softplus:1e-6\""};
    for (size_t k = 0; k < sizeof least / sizeof least[0]; k++) {
        dist_context *ctx = test_context();
        size_t size;
        unsigned char *bytes = file_of(least[k], good_tensors, "F32", -1, 0.0f, &size);
        dist_net *net = dist_net_load(ctx, bytes, size);
        CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
        free(bytes);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
    REFUSED(DIST_BAD_FILE, "dist.bound", "\"dist.bound\":\"9.9999e-7\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "dist.bound", "\"dist.bound\":\"-1e300\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "dist.activation", "\"dist.activation\":\"sine:9.9999e-7\"", good_tensors);
}

/* In place, all of the header's. Both are of the same length. */
static void rename_all(unsigned char *bytes, size_t size, const char *from, const char *to)
{
    size_t n = strlen(from);
    for (size_t i = 0; i + n <= size; i++)
        if (memcmp(bytes + i, from, n) == 0) memcpy(bytes + i, to, n);
}

/* What stands in the file of a layer, or of codes, is read or refused. */
TEST(nothing_of_a_layer_is_left_out_without_a_word)
{
    const char *layers = "module.lin0.weight 4 5;module.lin0.bias 4;module.lin1.weight 1 4;module.lin1.bias 1;";
    char tensors[256];
    size_t size;
    REFUSED(DIST_UNSUPPORTED, "tensor lin1.scale is of a layer", "",
            "lin0.weight 4 5;lin0.bias 4;lin1.weight 1 4;lin1.bias 1;lin1.scale 4;");
    REFUSED(DIST_BAD_FILE, "there are two networks", "",
            "module.lin0.weight 1 5;module.lin0.bias 1;lin0.weight_g 1 1;lin0.weight_v 1 5;lin0.bias 1;");
    REFUSED(DIST_BAD_FILE, "layer 0 has its weights twice", "",
            "lin0.weight 4 5;lin0.bias 4;lin0.weight_g 4 1;lin0.weight_v 4 5;lin1.weight 1 4;lin1.bias 1;");
    /* What makes another layer, but for its weight or half of it: the file would be a net of one layer less. */
    static const char *const behind[][2] = {{"lin1.weight_v 1 1;lin1.bias 1;", "lin1.weight_v is one of a"},
                                            {"lin1.weight_g 1 1;lin1.bias 1;", "lin1.weight_g is one of a"},
                                            {"lin1.parametrizations.weight.original0 1 1;", "original0 is one of a"},
                                            {"lin1.parametrizations.weight.original1 1 1;", "original1 is one of a"},
                                            {"lin1.bias 1;", "lin1.bias is there, but no weight of layer 1"},
                                            {"lin33.weight 1 1;", "lin33.weight is there, but no weight of layer 1"},
                                            {"lin99999999999.bias 1;", "is there, but no weight of layer 1"}};
    for (size_t k = 0; k < sizeof behind / sizeof behind[0]; k++) {
        snprintf(tensors, sizeof tensors, "lin0.weight 1 5;lin0.bias 1;%s", behind[k][0]);
        REFUSED(DIST_BAD_FILE, behind[k][1], "", tensors);
    }
    for (int with = 0; with < 2; with++) {
        dist_context *ctx = test_context();
        snprintf(tensors, sizeof tensors, "%s%s 3 2;", layers, with ? "module.codes" : "codes");
        unsigned char *bytes = file_of("", tensors, "F32", -1, 0.0f, &size);
        dist_net *net = dist_net_load(ctx, bytes, size);
        CHECK_EQUAL(3, dist_net_code_count(net));
        free(bytes);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
}

/* DeepSDF's decoder calls it bnK, and its files say nothing about it. */
TEST(layer_norm_that_only_its_tensors_tell_of_is_not_left_out)
{
    model_desc desc = {.normed = 1, .code_size = 3, .skip = 4};
    model m = model_make(&desc, 3);
    float points[30], code[3] = {0.2f, -0.1f, 0.4f}, sdf[2][10];
    test_random random = test_random_seed(5);
    test_random_fill(&random, 30, points, -0.7f, 0.7f);
    for (int k = 0; k < 4; k++) { /* as it is, without metadata, by the other name, and by that with metadata */
        dist_context *ctx = test_context();
        size_t size;
        unsigned char *bytes = model_file(&m, &size);
        if (k == 1 || k == 2) rename_all(bytes, size, "\"dist.norm\"", "\"other.key\"");
        if (k > 1) rename_all(bytes, size, "\"norm", "  \"bn");
        dist_net *net = dist_net_load(ctx, bytes, size);
        dist_shape *shape = dist_shape_create(ctx, net, code);
        dist_field field = dist_shape_field(shape);
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 10, points, sdf[k > 0], NULL), ctx);
        CHECK(memcmp(sdf[0], sdf[k > 0], sizeof sdf[0]) == 0);
        CHECK_EQUAL(m.count, dist_net_weight_count(net));
        free(bytes);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
    }
    model_free(&m);
    const char *some = "lin0.weight 4 5;lin0.bias 4;lin1.weight 4 4;lin1.bias 4;lin2.weight 1 4;lin2.bias 1;"
                       "bn1.weight 4;bn1.bias 4;";
    REFUSED(DIST_BAD_FILE, "norm0.weight is missing", "", some);
    REFUSED(DIST_UNSUPPORTED, "bn0.running_mean is of a batch normalization", "",
            "lin0.weight 4 5;lin0.bias 4;bn0.weight 4;bn0.bias 4;bn0.running_mean 4;lin1.weight 1 4;lin1.bias 1;");
    static const char whole[] = "lin0.weight 4 5;lin0.bias 4;norm0.weight 4;norm0.bias 4;lin1.weight 1 4;lin1.bias 1;";
    static const char *const more[5][2] = {{"norm1.weight 1;norm1.bias 1;", "norm1.weight is of a normalization"},
                                           {"norm0.gain 4;", "norm0.gain is of a normalization"},
                                           {"norm00.weight 4;", "norm00.weight is of a normalization"},
                                           {"bn2.bias 4;", "bn2.bias is of a normalization"},
                                           {"lin01.weight 4 4;", "lin01.weight is of a layer"}};
    for (int k = 0; k < 5; k++) {
        char tensors[256];
        sprintf(tensors, "%s%s", whole, more[k][0]);
        REFUSED(DIST_UNSUPPORTED, more[k][1], "", tensors);
    }
    REFUSED(DIST_BAD_FILE, "layer 0 has its normalization twice", "",
            "lin0.weight 4 5;lin0.bias 4;norm0.weight 4;norm0.bias 4;bn0.weight 4;bn0.bias 4;lin1.weight 1 4;"
            "lin1.bias 1;");
    REFUSED(DIST_UNSUPPORTED, "norm0.bias is of a normalization", "",
            "lin0.weight 4 5;lin0.bias 4;norm0.bias 4;lin1.weight 1 4;lin1.bias 1;");
}

TEST(tensors_that_do_not_fit_are_refused_with_a_sentence)
{
    REFUSED(DIST_BAD_FILE, "bias", "", "lin0.weight 4 5;lin0.bias 4;lin1.weight 1 4;");
    REFUSED(DIST_BAD_FILE, "bias", "", "lin0.weight 4 5;lin1.weight 1 4;lin1.bias 1;");
    REFUSED(DIST_BAD_FILE, "lin0.bias has 3 numbers, must have 4", "",
            "lin0.weight 4 5;lin0.bias 3;lin1.weight 1 4;lin1.bias 1;");
    REFUSED(DIST_BAD_FILE, "layer 1 is 6 wide at its input, but what feeds it has 4", "",
            "lin0.weight 4 5;lin0.bias 4;lin1.weight 1 6;lin1.bias 1;");
    REFUSED(DIST_BAD_FILE, "(out, in)", "", "lin0.weight 20;lin0.bias 4;");
    REFUSED(DIST_BAD_FILE, "no tensor is called lin0.weight", "", "layer.weight 4 5;");
    REFUSED(DIST_BAD_FILE, "lin", "", "lin0.weight 4 2;lin0.bias 4;lin1.weight 1 4;lin1.bias 1;");
    REFUSED(DIST_BAD_FILE, "dist.channels names 1", "\"dist.channels\":\"sdf\"",
            "lin0.weight 4 5;lin0.bias 4;lin1.weight 2 4;lin1.bias 2;");
    REFUSED(DIST_BAD_FILE, "17 numbers, of at most 16", "", "lin0.weight 17 5;lin0.bias 17;");
    REFUSED(DIST_BAD_FILE, "of 1 to 8192 by 1 to 16384", "", "lin0.weight 4 0;lin0.bias 4;");
    REFUSED(DIST_BAD_FILE, "lin0.weight_g has 3", "",
            "lin0.weight_g 3 1;lin0.weight_v 4 5;lin0.bias 4;lin1.weight 1 4;lin1.bias 1;");
    REFUSED(DIST_UNSUPPORTED, "lin0.weight_g must be (5, 1)", "", /* weight-norm over columns */
            "lin0.weight_g 1 5;lin0.weight_v 5 5;lin0.bias 5;lin1.weight 1 5;lin1.bias 1;");
    REFUSED(DIST_BAD_FILE, "lin0.weight_g is one of a", "",
            "lin0.weight_g 4 1;lin0.bias 4;lin1.weight 1 4;lin1.bias 1;");
    REFUSED(DIST_BAD_FILE, "norm0.weight is missing", "\"dist.norm\":\"layer\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "codes must be (n, 2)", "",
            "lin0.weight 4 5;lin0.bias 4;lin1.weight 1 4;lin1.bias 1;codes 2 3;");
    REFUSED(DIST_BAD_FILE, "codes must be (n, 2)", "",
            "lin0.weight 4 5;lin0.bias 4;lin1.weight 1 4;lin1.bias 1;codes 4;");
}

/* A hole between the layers would silently drop the rest. */
TEST(a_layer_missing_in_the_middle_is_refused)
{
    REFUSED(DIST_BAD_FILE, "", "",
            "lin0.weight 4 5;lin0.bias 4;lin1.weight 1 4;lin1.bias 1;lin3.weight 1 1;lin3.bias 1;");
}

TEST(a_net_of_more_layers_than_there_can_be_is_refused)
{
    char tensors[4096], *end = tensors;
    for (int l = 0; l <= INSIDE_LAYERS; l++)
        end += sprintf(end, "lin%d.weight %d %d;lin%d.bias %d;", l, l < INSIDE_LAYERS ? 4 : 1, l ? 4 : 5, l,
                       l < INSIDE_LAYERS ? 4 : 1);
    REFUSED(DIST_UNSUPPORTED, "more than 32 layers", "", tensors);
}

TEST(metadata_that_means_nothing_is_refused_with_a_sentence)
{
    static const char *const wrong[][2] = {{"dist.activation", "gelu"},
                                           {"dist.activation", "relu:2"},
                                           {"dist.activation", "softplus:"},
                                           {"dist.activation", "softplus:-1"},
                                           {"dist.activation", "softplus:1,2"},
                                           {"dist.activation", "sine:30,"},
                                           {"dist.activation", "sine:1e300"},
                                           {"dist.activation", "sine:nan"},
                                           {"dist.activation", ""},
                                           {"dist.output", "relu"},
                                           {"dist.output", "tanh:3"},
                                           {"dist.input", "xyz"},
                                           {"dist.skip", "3"},
                                           {"dist.skip", "0"},
                                           {"dist.skip", "1;2"},
                                           {"dist.skip", "-1"},
                                           {"dist.skip", "x"},
                                           {"dist.skip", "1e300"},
                                           {"dist.skip_order", "input"},
                                           {"dist.skip_scale", "0"},
                                           {"dist.skip_scale", "-1"},
                                           {"dist.encoding", "hash"},
                                           {"dist.encoding.levels", "1.5"},
                                           {"dist.encoding.levels", "17"},
                                           {"dist.encoding.levels", "-1"},
                                           {"dist.encoding.raw", "2"},
                                           {"dist.encoding.raw", "0.5"},
                                           {"dist.encoding.base", "0"},
                                           {"dist.encoding.order", "cos,sin"},
                                           {"dist.norm", "batch"},
                                           {"dist.norm.epsilon", "-1"},
                                           {"dist.level", "inf"},
                                           {"dist.level", "1 "},
                                           {"dist.bound", "0"},
                                           {"dist.bound", "-1"},
                                           {"dist.clamp", "-1"},
                                           {"dist.clamp", "abc"},
                                           {"dist.channels", ""},
                                           {"dist.channels", ",sdf"},
                                           {"dist.channels", "sdf,"},
                                           {"dist.channels", "sdf,sdf"},
                                           {"dist.channels", "r,g,b,g,sdf"},
                                           {"dist.code_size", "two"}};
    for (size_t k = 0; k < sizeof wrong / sizeof wrong[0]; k++) {
        char meta[128];
        snprintf(meta, sizeof meta, "\"%s\":\"%s\"", wrong[k][0], wrong[k][1]);
        REFUSED(DIST_BAD_FILE, wrong[k][0], meta, good_tensors);
    }
    REFUSED(DIST_BAD_FILE, "dist.bound is \"-1\", must be a number from 1e-6 to 1000000", "\"dist.bound\":\"-1\"",
            good_tensors);
    REFUSED(DIST_BAD_FILE, "dist.channels is \"sdf,sdf\", must be 1 to 16 different names",
            "\"dist.channels\":\"sdf,sdf\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "dist.encoding.raw is \"0.5\", must be a whole number from 0 to 1",
            "\"dist.encoding.raw\":\"0.5\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "dist.output is \"relu\", must be tanh|none|sigmoid|tanh:2", "\"dist.output\":\"relu\"",
            good_tensors);
    static const char *const unknown[] = {"dist.activaton", "dist.Norm", "dist.", "dist.skip_", "dist.norm.",
                                          "dist.raw", "dist.norm|norm.epsilon"};
    for (size_t k = 0; k < sizeof unknown / sizeof unknown[0]; k++) {
        char meta[64], part[64];
        snprintf(meta, sizeof meta, "\"%s\":\"none\"", unknown[k]);
        snprintf(part, sizeof part, "%s is not known", unknown[k]);
        REFUSED(DIST_BAD_FILE, part, meta, good_tensors);
    }
    REFUSED(DIST_BAD_FILE, "layer 0 takes 5", "\"dist.code_size\":\"3\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "layer 1, which dist.skip names, is 4 wide", "\"dist.skip\":\"1\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "layer 1 is 9 wide at its input, but what feeds it has 4: it sees the net's input again",
            "\"dist.skip\":\"2\"", "lin0.weight 4 5;lin0.bias 4;lin1.weight 4 9;lin1.bias 4;"
            "lin2.weight 1 9;lin2.bias 1;");
    REFUSED(DIST_BAD_FILE, "layer 1 is 8 wide at its input, but what feeds it has 4", "",
            "lin0.weight 4 5;lin0.bias 4;lin1.weight 1 8;lin1.bias 1;");
    char list[40 + 2 * 40] = "\"dist.skip\":\""; /* more layers than there can be */
    for (int k = 0; k < 40; k++) strcat(list, "1,");
    strcat(list, "\"");
    REFUSED(DIST_BAD_FILE, "dist.skip", list, good_tensors);
    REFUSED(DIST_BAD_FILE, "dist.encoding is fourier, so its levels are 1 to 16, not 0",
            "\"dist.encoding\":\"fourier\",\"dist.encoding.raw\":\"0\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "levels are 1 to 16, not 0", "\"dist.encoding\":\"fourier\"", good_tensors);
    REFUSED(DIST_UNSUPPORTED, "dist.encoding.base is 1e6 and dist.bound 2000, so angles go up to 2000000000",
            "\"dist.encoding\":\"fourier\",\"dist.encoding.levels\":\"1\",\"dist.encoding.base\":\"1e6\","
            "\"dist.bound\":\"2000\"", good_tensors);
    REFUSED(DIST_BAD_FILE, "dist.encoding.levels is 4, which only fourier has",
            "\"dist.encoding.levels\":\"4\"", good_tensors);
}

/* 15 digits, as of old, do not hold a double; pi is the default. */
TEST(the_base_of_an_encoding_is_saved_to_the_last_bit)
{
    static const char *const bases[] = {NULL, "9.783935319462859e-6", "9.7866019443823492e-05", "2", "0.1", "1e6",
                                        "499553.45723394846", "0.33333333333333331"};
    for (size_t k = 0; k < sizeof bases / sizeof bases[0]; k++) {
        char meta[160];
        size_t size[3];
        dist_context *ctx = test_context();
        snprintf(meta, sizeof meta, "\"dist.encoding\":\"fourier\",\"dist.encoding.levels\":\"1\"%s%s%s",
                 bases[k] ? ",\"dist.encoding.base\":\"" : "", bases[k] ? bases[k] : "", bases[k] ? "\"" : "");
        unsigned char *bytes = file_of(meta, "lin0.weight 1 9;lin0.bias 1;", "F32", -1, 0.0f, &size[0]);
        dist_net *net = dist_net_load(ctx, bytes, size[0]);
        REQUIRE(net != NULL);
        unsigned char *first = saved(ctx, net, &size[1]);
        dist_net *again = dist_net_load(ctx, first, size[1]);
        REQUIRE(again != NULL);
        unsigned char *second = saved(ctx, again, &size[2]);
        const double base = bases[k] ? strtod(bases[k], NULL) : 3.14159265358979323846;
        CHECK(inside_encoding_base(net) == base && inside_encoding_base(again) == base);
        CHECK(size[1] == size[2] && memcmp(first, second, size[1]) == 0);
        dist_net_destroy(again);
        dist_net_destroy(net);
        free(bytes);
        free(first);
        free(second);
        dist_context_destroy(ctx);
    }
}

TEST(weights_that_are_not_finite_and_unknown_types_are_refused)
{
    refused(DIST_NOT_FINITE, "lin0.weight holds", "", good_tensors, "F32", 3, not_a_number(), __FILE__, __LINE__);
    refused(DIST_NOT_FINITE, "lin2.bias holds", "", good_tensors, "F32", 48, not_a_number(), __FILE__, __LINE__);
    refused(DIST_NOT_FINITE, "codes holds", "", "lin0.weight 1 5;lin0.bias 1;codes 1 2;", "F32", 7, not_a_number(),
            __FILE__, __LINE__);
    refused(DIST_UNSUPPORTED, "must be F32, F16 or BF16", "", good_tensors, "F64", -1, 0.0f, __FILE__, __LINE__);
}

TEST(a_file_cut_short_anywhere_is_refused)
{
    size_t size;
    unsigned char *bytes = file_of("", good_tensors, "F32", -1, 0.0f, &size);
    for (size_t n = 0; n < size; n += test_quick() ? 29 : 3) {
        dist_context *ctx = test_context();
        unsigned char *exact = (unsigned char *)malloc(n + 1);
        REQUIRE(exact != NULL);
        memcpy(exact, bytes, n);
        CHECK(dist_net_load(ctx, exact, n) == NULL);
        CHECK_STATUS(DIST_BAD_FILE, dist_context_status(ctx), ctx);
        free(exact);
        dist_context_destroy(ctx);
    }
    free(bytes);
}

TEST(null_handles_are_refused)
{
    dist_context *ctx = test_context();
    dist_net_desc d = small_desc();
    dist_net *net = dist_net_create(ctx, &d);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    float x[5] = {0};
    size_t size;
    CHECK(dist_net_load(NULL, x, 4) == NULL);
    CHECK(dist_net_load(ctx, NULL, 4) == NULL);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_context_status(ctx), ctx);
    CHECK(dist_net_load_file(ctx, NULL) == NULL);
    CHECK(dist_net_create(NULL, &d) == NULL);
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_net_save(NULL, net, NULL, 0, &size));
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_save(ctx, NULL, NULL, 0, &size), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_save(ctx, net, NULL, 0, NULL), ctx);
    CHECK(dist_net_save_file(ctx, NULL, "x") != DIST_OK);
    CHECK(dist_net_save_file(ctx, net, NULL) != DIST_OK);
    CHECK_EQUAL(0, dist_net_code_size(NULL) + dist_net_code_count(NULL) + dist_net_channels(NULL));
    CHECK(dist_net_code(NULL, 0) == NULL && dist_net_weights(NULL) == NULL);
    CHECK_EQUAL(0, dist_net_operations(NULL, 0) + dist_net_weight_count(NULL));
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_set_weights(ctx, NULL, x), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_set_weights(ctx, net, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_set_code(ctx, NULL, 0, x), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_net_set_code(ctx, net, 0, NULL), ctx);
    CHECK(dist_shape_create(NULL, net, NULL) == NULL);
    CHECK(dist_shape_create(ctx, NULL, NULL) == NULL);
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_shape_set_code(NULL, x));
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_shape_eval(ctx, NULL, 1, x, x + 3), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_shape_eval(ctx, shape, 1, NULL, x + 3), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_shape_eval(ctx, shape, 1, x, NULL), ctx);
    dist_field none = dist_shape_field(NULL);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_eval(ctx, &none, 1, x, x + 3, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_eval(ctx, NULL, 1, x, x + 3, NULL), ctx);
    dist_net_destroy(NULL);
    dist_shape_destroy(NULL);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* ---- BLAS -------------------------------------------------------------------------------------------------------- */

typedef struct plain_blas {
    int calls;
    int wrong; /* 1: forgets beta; 2: does not transpose b; 3: takes lda for packed */
} plain_blas;

static void plain_sgemm(void *user, int transpose_a, int transpose_b, int m, int n, int k, float alpha, const float *a,
                        int lda, const float *b, int ldb, float beta, float *c, int ldc)
{
    plain_blas *blas = (plain_blas *)user;
    blas->calls++;
    if (blas->wrong == 2) transpose_b = 0;
    if (blas->wrong == 3) lda = transpose_a ? m : k;
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) {
            float sum = 0.0f;
            for (int l = 0; l < k; l++)
                sum +=
                    (transpose_a ? a[l * lda + i] : a[i * lda + l]) * (transpose_b ? b[j * ldb + l] : b[l * ldb + j]);
            float old = beta == 0.0f || blas->wrong == 1 ? 0.0f : beta * c[i * ldc + j];
            c[i * ldc + j] = alpha * sum + old;
        }
}

enum { BLAS_POINTS = 2 * INSIDE_WIDE + INSIDE_BLOCK + 5 }; /* values alone go several blocks at a time */

typedef struct blas_result {
    float sdf[POINTS], gradient[3 * POINTS], code[5], values[BLAS_POINTS];
    float *weights;
    int calls;
} blas_result;

static void blas_run(int width, int use, int activation, blas_result *r)
{
    plain_blas blas = {0, 0};
    dist_context_desc desc = test_context_desc();
    dist_net_desc d = small_desc();
    float points[3 * POINTS], d_sdf[POINTS], code[5] = {0.5f, -0.5f, 1, 0, 0.25f};
    dist_gradients grads;
    test_random random = test_random_seed(4);
    memset(r, 0, sizeof *r);
    desc.blas.user = &blas;
    desc.blas.sgemm_fn = use ? plain_sgemm : NULL;
    dist_context *ctx = dist_context_create(&desc);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    blas.calls = 0;
    d.width = width;
    d.activation = activation;
    d.scale = activation == DIST_ACTIVATION_SOFTPLUS ? 10.0f : 0.0f;
    dist_net *net = dist_net_create(ctx, &d);
    dist_shape *shape = dist_shape_create(ctx, net, code);
    dist_field field = dist_shape_field(shape);
    test_random_fill(&random, 3 * POINTS, points, -1.0f, 1.0f);
    test_random_fill(&random, POINTS, d_sdf, -1.0f, 1.0f);
    r->weights = (float *)calloc(field.weight_count, sizeof(float));
    memset(&grads, 0, sizeof grads);
    grads.code = r->code;
    grads.weights = r->weights;
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, POINTS, points, r->sdf, r->gradient), ctx);
    CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &field, POINTS, points, d_sdf, NULL, NULL, NULL, &grads), ctx);
    static float many[3 * BLAS_POINTS];
    test_random_fill(&random, 3 * BLAS_POINTS, many, -1.0f, 1.0f);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, BLAS_POINTS, many, r->values, NULL), ctx);
    r->calls = blas.calls;
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(the_users_blas_gives_the_same_numbers_for_wide_layers_and_is_left_alone_for_narrow_ones)
{
    static const int activations[2] = {DIST_ACTIVATION_RELU, DIST_ACTIVATION_SOFTPLUS};
    for (int k = 0; k < 4; k++) {
        blas_result a, b;
        int width = k % 2 ? 208 : 144;
        blas_run(width, 0, activations[k / 2], &a);
        blas_run(width, 1, activations[k / 2], &b);
        CHECK((b.calls > 0) == (width >= 192));
        CHECK_NEAR_ARRAY(POINTS, a.sdf, b.sdf, 1e-6);
        CHECK_NEAR_ARRAY(3 * POINTS, a.gradient, b.gradient, 1e-6);
        CHECK_NEAR_ARRAY(BLAS_POINTS, a.values, b.values, 1e-6);
        CHECK_NEAR_ARRAY(5, a.code, b.code, 1e-5);
        CHECK_NEAR_ARRAY((size_t)width * 9, a.weights, b.weights, 1e-5);
        free(a.weights);
        free(b.weights);
    }
}

TEST(a_wrong_blas_is_refused_when_the_context_is_made)
{
    for (int wrong = 0; wrong <= 3; wrong++) {
        plain_blas blas = {0, 0};
        blas.wrong = wrong;
        dist_context_desc desc = test_context_desc();
        desc.blas.user = &blas;
        desc.blas.sgemm_fn = plain_sgemm;
        dist_context *ctx = dist_context_create(&desc);
        CHECK_STATUS(wrong ? DIST_BAD_ARGUMENT : DIST_OK, dist_context_status(ctx), ctx);
        if (wrong) CHECK_TEXT("blas.sgemm_fn", dist_context_message(ctx));
        if (wrong) CHECK(dist_net_create(ctx, NULL) == NULL);
        dist_context_destroy(ctx);
    }
}

/* ---- real decoders ----------------------------------------------------------------------------------------------- */

/* "name" or "name.3" of the folder nets: the net and the number behind the dot, -1 without. */
static dist_net *real_net(dist_context *ctx, const char *name, int *code)
{
    char file[128];
    size_t n = strcspn(name, ".");
    *code = name[n] ? (int)strtol(name + n + 1, NULL, 10) : -1;
    snprintf(file, sizeof file, "nets/%.*s.safetensors", (int)n, name);
    return dist_net_load_file(ctx, test_data_path(file));
}

/* Does the reference's gradient hold a rounding away from p, on the other side of a kink? */
static int kink_beside(dist_context *ctx, const dist_field *field, const float p[3], const double expected[3])
{
    float points[18], sdf[6], gradient[18];
    for (int i = 0; i < 18; i++) points[i] = p[i % 3] + (i / 3 / 2 == i % 3 ? (i / 3 % 2 ? -3e-6f : 3e-6f) : 0.0f);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, field, 6, points, sdf, gradient), ctx);
    for (int i = 0; i < 6; i++) {
        double error = 0.0, length = 0.0;
        for (int k = 0; k < 3; k++) {
            double difference = (double)gradient[3 * i + k] - expected[k];
            error += difference * difference;
            length += expected[k] * expected[k];
        }
        if (error <= 1e-8 * length) return 1;
    }
    return 0;
}

static void real_check(const char *name, int flat_allowed)
{
    char file[128];
    size_t size;
    int code, flat = 0, kinks = 0;
    snprintf(file, sizeof file, "nets/%s.ref.f64", name);
    double *reference = (double *)test_file_read(test_data_path(file), &size);
    if (!reference) SKIP("the real decoders are not here");
    dist_context *ctx = test_context();
    dist_net *net = real_net(ctx, name, &code);
    dist_shape *shape = dist_shape_create(ctx, net, code >= 0 ? dist_net_code(net, code) : NULL);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    if (!shape) {
        free(reference);
        return;
    }
    dist_field field = dist_shape_field(shape);
    int n = dist_net_code_size(net), row = 7 + n, rows = (int)(size / sizeof(double)) / row;
    int code_rows = test_quick()                            ? 4
                    : dist_net_operations(net, 1) > 1000000 ? 24
                                                            : 64,
        sine = strstr(name, "sine") != NULL;
    double largest = 1.0, steepest = 0.0, steepest_code = 0.0, f_error = 0.0, g_error = 0.0, c_error = 0.0;
    float *points = (float *)calloc((size_t)rows * 7, sizeof(float)),
          *d_code = (float *)calloc((size_t)n + 1, sizeof(float));
    float *sdf = points + 3 * rows, *gradient = sdf + rows;
    for (int i = 0; i < rows; i++) {
        const double *r = reference + i * row;
        double length = 0.0;
        for (int k = 0; k < 3; k++) points[3 * i + k] = (float)r[k];
        largest = fmax(largest, fabs(r[3]));
        steepest = fmax(steepest, sqrt(r[4] * r[4] + r[5] * r[5] + r[6] * r[6]));
        for (int j = 0; j < n; j++) length += r[7 + j] * r[7 + j];
        steepest_code = fmax(steepest_code, sqrt(length));
    }
    CHECK_EQUAL(256, rows);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, (size_t)rows, points, sdf, gradient), ctx);
    for (int i = 0; i < rows; i++) {
        const double *r = reference + i * row;
        double error = 0.0, length = 0.0;
        float one = 1.0f;
        dist_gradients grads;
        f_error = fmax(f_error, fabs((double)sdf[i] - r[3]));
        for (int k = 0; k < 3; k++) {
            error += ((double)gradient[3 * i + k] - r[4 + k]) * ((double)gradient[3 * i + k] - r[4 + k]);
            length += r[4 + k] * r[4 + k];
        }
        /* On a plateau the gradient is what is left when terms of the usual size cancel: float's rounding of those. */
        if (sqrt(length) <= 1e-5 * steepest) {
            flat++;
            CHECK(sqrt(error) <= 1e-7 * steepest);
            continue;
        }
        if (sqrt(error / length) > 1e-4 && kink_beside(ctx, &field, points + 3 * i, r + 4)) {
            kinks++;
            continue;
        }
        g_error = fmax(g_error, sqrt(error / length));
        if (n == 0 || i >= code_rows) continue;
        memset(&grads, 0, sizeof grads);
        memset(d_code, 0, (size_t)n * sizeof(float));
        grads.code = d_code;
        CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &field, 1, points + 3 * i, &one, NULL, NULL, NULL, &grads), ctx);
        error = length = 0.0;
        for (int j = 0; j < n; j++) {
            error += ((double)d_code[j] - r[7 + j]) * ((double)d_code[j] - r[7 + j]);
            length += r[7 + j] * r[7 + j];
        }
        if (sqrt(length) > 1e-5 * steepest_code) c_error = fmax(c_error, sqrt(error / length));
    }
    CHECK_NEAR(0.0, f_error, (sine ? 2e-5 : 2e-6) * largest);
    CHECK_NEAR(0.0, g_error, 1e-4);
    CHECK_NEAR(0.0, c_error, 1e-4);
    CHECK(flat <= flat_allowed);
    CHECK(kinks <= 2);
    if (test_state.verbose)
        printf("    %s: f %.1e of %.2f, point gradient %.1e, code gradient %.1e, %d flat\n", name, f_error, largest,
               g_error, c_error, flat);
    free(points);
    free(d_code);
    free(reference);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(bob_spot_0_matches_its_reference) { real_check("bob_spot.0", 0); }
TEST(bob_spot_1_matches_its_reference) { real_check("bob_spot.1", 0); }
TEST(bunny_relu_matches_its_reference) { real_check("bunny_relu", 0); }
TEST(chairs_1_matches_its_reference) { real_check("chairs.1", 0); }
TEST(chairs_3_matches_its_reference) { real_check("chairs.3", 0); }
TEST(deepsdf_512_0_matches_its_reference) { real_check("deepsdf_512.0", 0); }
TEST(deepsdf_512_2_matches_its_reference) { real_check("deepsdf_512.2", 0); }
TEST(deepsdf_512_4_matches_its_reference) { real_check("deepsdf_512.4", 0); }
TEST(deepsdf_512_8_matches_its_reference) { real_check("deepsdf_512.8", 0); }
TEST(deepsdf_512_he_0_matches_its_reference) { real_check("deepsdf_512_he.0", 0); }
TEST(fox_matches_its_reference) { real_check("fox", 0); }
TEST(mug_camera_bottle_0_matches_its_reference) { real_check("mug_camera_bottle.0", 0); }
TEST(mug_camera_bottle_1_matches_its_reference) { real_check("mug_camera_bottle.1", 0); }
TEST(mug_camera_bottle_2_matches_its_reference) { real_check("mug_camera_bottle.2", 0); }
/* These learned a distance clamped at 0.5: almost half of the points lie where f is flat, at tanh(0.5). */
TEST(primitives_7_matches_its_reference) { real_check("primitives.7", 128); }
TEST(primitives_13_matches_its_reference) { real_check("primitives.13", 128); }
TEST(primitives_15_matches_its_reference) { real_check("primitives.15", 128); }
TEST(primitives_29_matches_its_reference) { real_check("primitives.29", 128); }
TEST(rings_matches_its_reference) { real_check("rings", 0); }
TEST(round_cross_0_matches_its_reference) { real_check("round_cross.0", 0); }
TEST(round_cross_10_matches_its_reference) { real_check("round_cross.10", 0); }
TEST(spot_geometry_0_matches_its_reference) { real_check("spot_geometry.0", 0); }
TEST(two_spheres_sine_matches_its_reference) { real_check("two_spheres_sine", 0); }

TEST(colors_of_spot_texture_match_its_reference)
{
    size_t size;
    int code;
    double worst = 0.0;
    double *reference = (double *)test_file_read(test_data_path("nets/spot_texture.ref.f64"), &size);
    if (!reference) SKIP("the real decoders are not here");
    dist_context *ctx = test_context();
    dist_net *net = real_net(ctx, "spot_texture", &code);
    dist_shape *shape = dist_shape_create(ctx, net, dist_net_code(net, 0));
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    REQUIRE(shape != NULL && dist_net_channels(net) == 3);
    int rows = (int)(size / sizeof(double)) / 7;
    CHECK_EQUAL(1000, rows);
    float *points = (float *)calloc((size_t)rows * 6, sizeof(float)), *color = points + 3 * rows;
    for (int i = 0; i < 3 * rows; i++) points[i] = (float)reference[i / 3 * 7 + i % 3];
    CHECK_STATUS(DIST_OK, dist_shape_eval(ctx, shape, (size_t)rows, points, color), ctx);
    for (int i = 0; i < 3 * rows; i++) worst = fmax(worst, fabs((double)color[i] - reference[i / 3 * 7 + 4 + i % 3]));
    CHECK_NEAR(0.0, worst, 1e-5);
    if (test_state.verbose) printf("    spot_texture: colors %.1e\n", worst);
    free(points);
    free(reference);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(every_form_of_file_gives_the_values_that_the_format_says);
    RUN(every_form_of_file_gives_point_gradients_that_match_differences);
    RUN(every_form_of_file_gives_code_gradients_that_match_differences);
    RUN(what_the_file_says_of_code_channels_bound_and_clamp_is_what_the_net_tells);
    RUN(color_is_the_three_channels_behind_one_another);
    RUN(a_code_folded_by_hand_gives_the_same_values);
    RUN(setting_a_code_equals_making_the_shape_with_it);
    RUN(operations_of_a_net_are_its_multiply_adds);
    RUN(a_point_has_the_same_bits_in_every_batch);
    RUN(gradients_of_lone_points_are_finite_where_those_of_others_are);
    RUN(every_level_of_an_encoded_point_has_a_floats_digits);
    RUN(a_layer_norm_of_sums_of_any_size_is_the_same);
    RUN(a_dead_unit_that_is_left_out_changes_no_bit);
    RUN(the_order_of_units_in_memory_does_not_show);
    RUN(a_few_points_have_the_bits_of_many);
    RUN(rows_that_are_left_out_change_no_bit);
    RUN(a_saved_net_loads_and_saves_to_the_same_bytes_and_values);
    RUN(saving_into_too_small_a_buffer_is_refused);
    RUN(a_file_that_takes_nothing_is_told_of);
    RUN(a_net_saved_to_a_file_is_loaded_from_it);
    RUN(a_small_net_says_how_it_rounds);
    RUN(a_geometric_start_is_near_the_distance_to_a_sphere_of_half_the_bound);
    RUN(a_seed_gives_the_same_net_and_another_seed_another);
    RUN(a_net_made_has_the_form_asked_for);
    RUN(a_net_that_cannot_be_made_is_refused);
    RUN(set_weights_makes_one_net_the_other);
    RUN(numbers_that_are_not_finite_are_refused_and_change_nothing);
    RUN(the_file_that_the_wrong_ones_are_made_of_is_right);
    RUN(channels_that_end_the_header_are_read_no_further);
    RUN(spaces_around_the_channels_names_are_none_of_theirs);
    RUN(channels_without_names_are_a_distance_and_more);
    RUN(the_least_numbers_a_file_may_say_are_floats);
    RUN(nothing_of_a_layer_is_left_out_without_a_word);
    RUN(layer_norm_that_only_its_tensors_tell_of_is_not_left_out);
    RUN(tensors_that_do_not_fit_are_refused_with_a_sentence);
    RUN(a_layer_missing_in_the_middle_is_refused);
    RUN(a_net_of_more_layers_than_there_can_be_is_refused);
    RUN(metadata_that_means_nothing_is_refused_with_a_sentence);
    RUN(the_base_of_an_encoding_is_saved_to_the_last_bit);
    RUN(weights_that_are_not_finite_and_unknown_types_are_refused);
    RUN(a_file_cut_short_anywhere_is_refused);
    RUN(null_handles_are_refused);
    RUN(the_users_blas_gives_the_same_numbers_for_wide_layers_and_is_left_alone_for_narrow_ones);
    RUN(a_wrong_blas_is_refused_when_the_context_is_made);
    RUN(bob_spot_0_matches_its_reference);
    RUN(bob_spot_1_matches_its_reference);
    RUN(bunny_relu_matches_its_reference);
    RUN(chairs_1_matches_its_reference);
    RUN(chairs_3_matches_its_reference);
    RUN(deepsdf_512_0_matches_its_reference);
    RUN(deepsdf_512_2_matches_its_reference);
    RUN(deepsdf_512_4_matches_its_reference);
    RUN(deepsdf_512_8_matches_its_reference);
    RUN(deepsdf_512_he_0_matches_its_reference);
    RUN(fox_matches_its_reference);
    RUN(mug_camera_bottle_0_matches_its_reference);
    RUN(mug_camera_bottle_1_matches_its_reference);
    RUN(mug_camera_bottle_2_matches_its_reference);
    RUN(primitives_7_matches_its_reference);
    RUN(primitives_13_matches_its_reference);
    RUN(primitives_15_matches_its_reference);
    RUN(primitives_29_matches_its_reference);
    RUN(rings_matches_its_reference);
    RUN(round_cross_0_matches_its_reference);
    RUN(round_cross_10_matches_its_reference);
    RUN(spot_geometry_0_matches_its_reference);
    RUN(two_spheres_sine_matches_its_reference);
    RUN(colors_of_spot_texture_match_its_reference);
    return test_report();
}
