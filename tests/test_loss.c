/* SPDX-License-Identifier: MIT-0
   Losses and Adam: values and gradients against the formulas in double, and what must not count. */
#include "test.h"

enum { N = 200, KINDS = 6 };
enum { DEPTH, NORMAL, SILHOUETTE, WRONG, COLOR, CODE };

typedef struct loss_case {
    float x[3 * N], target[3 * N], d_x[3 * N];
    unsigned char mask[N], shape[N];
} loss_case;

static size_t loss_size(int kind)
{
    return kind == NORMAL || kind == COLOR ? 3 * N : N;
}

static float loss_call(int kind, const loss_case *c, float weight, float *d_x)
{
    switch (kind) {
    case DEPTH: return dist_loss_depth(N, c->x, c->target, c->mask, weight, d_x);
    case NORMAL: return dist_loss_normal(N, c->x, c->target, c->mask, weight, d_x);
    case SILHOUETTE: return dist_loss_silhouette(N, c->x, c->shape, weight, d_x);
    case WRONG: return dist_loss_silhouette_wrong(N, c->x, c->shape, weight, d_x);
    case COLOR: return dist_loss_color(N, c->x, c->target, c->mask, weight, d_x);
    default: return dist_loss_code(N, c->x, weight, d_x);
    }
}

/* The same in double, by other means: x comes as doubles, so that it can be moved by less than a float shows. */
static double loss_reference(int kind, const loss_case *c, const double *x)
{
    double sum = 0, count = 0, miss[2] = {0, 0}, over[2] = {0, 0};
    for (size_t i = 0; i < N; i++) {
        const float *t = c->target + 3 * i;
        double length = sqrt((double)t[0] * (double)t[0] + (double)t[1] * (double)t[1] + (double)t[2] * (double)t[2]);
        if (kind == SILHOUETTE) {
            sum += c->shape[i] ? fmax(0, x[i]) : fmax(0, -x[i]);
            count += 1;
        } else if (kind == WRONG) {
            double *set = c->shape[i] ? miss : over, value = c->shape[i] ? x[i] : -x[i];
            if (value > 0) set[0] += value, set[1] += 1;
        } else if (kind == CODE) {
            sum += x[i] * x[i];
            count = 1;
        } else if (kind == DEPTH && c->mask[i]) {
            sum += fabs(x[i] - (double)c->target[i]);
            count += 1;
        } else if (kind == NORMAL && c->mask[i]) {
            for (size_t k = 0; k < 3; k++) sum -= x[3 * i + k] * (double)t[k] / length;
            count += 1;
        } else if (kind == COLOR && c->mask[i]) {
            for (size_t k = 0; k < 3; k++) sum += fabs(x[3 * i + k] - (double)t[k]);
            count += 3;
        }
    }
    return kind == WRONG ? miss[0] / miss[1] + over[0] / over[1] : sum / count;
}

static void loss_fill(loss_case *c, int kind, uint64_t seed)
{
    test_random r = test_random_seed(seed);
    memset(c, 0, sizeof *c);
    test_random_fill(&r, 3 * N, c->x, -1.0f, 1.0f);
    test_random_fill(&r, 3 * N, c->target, kind == DEPTH ? 0.1f : -1.0f, 2.0f);
    for (size_t i = 0; i < N; i++) {
        c->mask[i] = (unsigned char)(test_random_bits(&r) % 3);
        c->shape[i] = (unsigned char)(test_random_bits(&r) % 2);
    }
}

TEST(losses_are_their_formulas)
{
    for (int kind = 0; kind < KINDS; kind++) {
        loss_case c;
        double x[3 * N];
        loss_fill(&c, kind, 1u + (uint64_t)kind);
        for (size_t i = 0; i < 3 * N; i++) x[i] = (double)c.x[i];
        double expected = 2.5 * loss_reference(kind, &c, x);
        CHECK_NEAR(expected, loss_call(kind, &c, 2.5f, NULL), 1e-6 * (1 + fabs(expected)));
    }
}

TEST(loss_gradients_are_central_differences)
{
    for (int kind = 0; kind < KINDS; kind++) {
        loss_case c;
        double x[3 * N], h = 1e-6;
        size_t excluded = 0, size = loss_size(kind);
        loss_fill(&c, kind, 11u + (uint64_t)kind);
        for (size_t i = 0; i < size; i++) x[i] = (double)c.x[i];
        loss_call(kind, &c, 2.5f, c.d_x);
        for (size_t i = 0; i < size; i++) {
            double kink = kind == SILHOUETTE || kind == WRONG ? x[i] : x[i] - (double)c.target[i];
            if (kind != CODE && kind != NORMAL && fabs(kink) < 10 * h) {
                excluded++;
                continue;
            }
            double middle = x[i];
            x[i] = middle + h;
            double up = loss_reference(kind, &c, x);
            x[i] = middle - h;
            double down = loss_reference(kind, &c, x);
            x[i] = middle;
            CHECK_NEAR(2.5 * (up - down) / (2 * h), c.d_x[i], 1e-6);
        }
        CHECK(excluded * 10 <= size);
    }
}

TEST(loss_gradients_are_added)
{
    for (int kind = 0; kind < KINDS; kind++) {
        loss_case c;
        loss_fill(&c, kind, 21);
        float twice[3 * N];
        loss_call(kind, &c, 1.0f, c.d_x);
        for (size_t i = 0; i < 3 * N; i++) twice[i] = 0.5f + c.d_x[i];
        for (size_t i = 0; i < 3 * N; i++) c.d_x[i] = 0.5f;
        loss_call(kind, &c, 1.0f, c.d_x);
        CHECK_NEAR_ARRAY(loss_size(kind), twice, c.d_x, 1e-6);
    }
}

static float loss_bits(uint32_t bits)
{
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

TEST(depth_targets_that_are_not_seen_do_not_count)
{
    float depth[8] = {1, 1, 1, 1, 1, 1, 1, 1}, target[8], d_depth[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    unsigned char mask[8] = {1, 1, 1, 1, 1, 1, 0, 1};
    target[0] = loss_bits(0x7fc00000u);
    target[1] = loss_bits(0x7f800000u);
    target[2] = loss_bits(0xff800000u);
    target[3] = 0.0f;
    target[4] = -1.0f;
    target[5] = 1e11f;
    target[6] = 2.0f;
    target[7] = 1.5f;
    CHECK_NEAR(0.5, dist_loss_depth(8, depth, target, mask, 1.0f, d_depth), 0);
    for (size_t i = 0; i < 7; i++) CHECK_NEAR(0, d_depth[i], 0);
    CHECK_NEAR(-1, d_depth[7], 0);
    CHECK_NEAR(0, dist_loss_depth(7, depth, target, mask, 1.0f, d_depth), 0);
}

TEST(losses_over_nothing_are_zero_without_gradient)
{
    for (int kind = 0; kind < KINDS; kind++) {
        loss_case c;
        loss_fill(&c, kind, 31);
        for (size_t i = 0; i < 3 * N; i++) c.target[i] = loss_bits(0x7fc00000u);
        if (kind == SILHOUETTE || kind == WRONG || kind == CODE)
            for (size_t i = 0; i < 3 * N; i++) c.x[i] = loss_bits(0x7fc00000u);
        CHECK_NEAR(0, loss_call(kind, &c, 1.0f, c.d_x), 0);
        for (size_t i = 0; i < 3 * N; i++) CHECK_NEAR(0, c.d_x[i], 0);
    }
    CHECK_NEAR(0, dist_loss_depth(0, NULL, NULL, NULL, 1.0f, NULL), 0);
    CHECK_NEAR(0, dist_loss_normal(5, NULL, NULL, NULL, 1.0f, NULL), 0);
    CHECK_NEAR(0, dist_loss_silhouette(5, NULL, NULL, 1.0f, NULL), 0);
    CHECK_NEAR(0, dist_loss_silhouette_wrong(5, NULL, NULL, 1.0f, NULL), 0);
    CHECK_NEAR(0, dist_loss_color(5, NULL, NULL, NULL, 1.0f, NULL), 0);
    CHECK_NEAR(0, dist_loss_code(5, NULL, 1.0f, NULL), 0);
}

TEST(a_weight_that_is_not_finite_is_a_weight_of_zero)
{
    const float weights[] = {loss_bits(0x7fc00000u), loss_bits(0x7f800000u), loss_bits(0xff800000u)};
    for (int kind = 0; kind < KINDS; kind++) {
        for (int k = 0; k < 3; k++) {
            loss_case c;
            loss_fill(&c, kind, 32);
            CHECK_NEAR(0, loss_call(kind, &c, weights[k], c.d_x), 0);
            for (size_t i = 0; i < 3 * N; i++) CHECK_NEAR(0, c.d_x[i], 0);
        }
    }
}

/* However few pixels are wrong, they weigh the same; a set without any adds nothing. */
TEST(the_silhouette_of_wrong_pixels_does_not_fade)
{
    float silhouette[8] = {0.5f, -1, -1, -1, 2, 2, 2, 2}, d[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    unsigned char target[8] = {1, 1, 1, 1, 0, 0, 0, 0};
    CHECK_NEAR(1.5, dist_loss_silhouette_wrong(8, silhouette, target, 3.0f, d), 0);
    CHECK_NEAR(3, d[0], 0);
    for (size_t i = 1; i < 8; i++) CHECK_NEAR(0, d[i], 0);
    silhouette[6] = -0.25f;
    CHECK_NEAR(2.25, dist_loss_silhouette_wrong(8, silhouette, target, 3.0f, d), 0);
    CHECK_NEAR(-3, d[6], 0);
}

TEST(target_normals_are_normalized_and_zero_ones_left_out)
{
    float normal[6] = {0, 0, 1, 0, 0, 1}, target[6] = {0, 0, 7, 0, 0, 0}, d_normal[6] = {0, 0, 0, 0, 0, 0};
    CHECK_NEAR(-1, dist_loss_normal(2, normal, target, NULL, 1.0f, d_normal), 1e-7);
    CHECK_NEAR(-1, d_normal[2], 1e-7);
    CHECK_NEAR(0, d_normal[5], 0);
}

TEST(a_million_small_terms_are_summed_without_loss)
{
    size_t n = 1000000;
    float *x = (float *)malloc(n * sizeof(float));
    REQUIRE(x);
    for (size_t i = 0; i < n; i++) x[i] = 0.1f;
    CHECK_NEAR(1e4, dist_loss_code(n, x, 1.0f, NULL), 1e-2);
    free(x);
}

TEST(adam_is_its_formula_for_a_hundred_steps)
{
    float x[4] = {1, -2, 3, 0.5f}, g[4], moments[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    double y[4] = {1, -2, 3, 0.5}, m[4] = {0, 0, 0, 0}, v[4] = {0, 0, 0, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    for (int t = 1; t <= 100; t++) {
        for (size_t i = 0; i < 4; i++) {
            g[i] = 2 * x[i] + 0.1f * (float)i;
            m[i] = 0.9 * m[i] + 0.1 * (double)g[i];
            v[i] = 0.999 * v[i] + 0.001 * (double)g[i] * (double)g[i];
            y[i] -= 0.01 * (m[i] / (1 - pow(0.9, t))) / (sqrt(v[i] / (1 - pow(0.999, t))) + 1e-8);
        }
        CHECK_EQUAL(0, dist_adam_step(&adam, 4, x, g));
    }
    CHECK_EQUAL(100, adam.step);
    for (size_t i = 0; i < 4; i++) CHECK_NEAR(y[i], x[i], 1e-5);
}

TEST(adam_with_zero_gradients_never_moves)
{
    float x[2] = {1, -2}, g[2] = {0, 0}, moments[4] = {0, 0, 0, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    for (int t = 0; t < 1000; t++) dist_adam_step(&adam, 2, x, g);
    CHECK_NEAR(1, x[0], 0);
    CHECK_NEAR(-2, x[1], 0);
}

TEST(adam_with_a_rate_that_is_not_finite_never_moves)
{
    float x[2] = {1, -2}, g[2] = {1, 1}, moments[4] = {0, 0, 0, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    for (int k = 0; k < 2; k++) {
        adam.rate = loss_bits(k ? 0x7f800000u : 0x7fc00000u);
        CHECK_EQUAL(2, dist_adam_step(&adam, 2, x, g));
        CHECK_EQUAL(0, adam.step);
    }
    CHECK_NEAR(1, x[0], 0);
    CHECK_NEAR(0, moments[0], 0);
}

TEST(adam_stays_finite_for_huge_and_tiny_gradients)
{
    float x[4] = {1, 1, 1, 1}, g[4] = {1e30f, -3.4e38f, 1e-30f, -1e-38f}, moments[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    for (int t = 0; t < 1000; t++) {
        if (t == 500)
            for (size_t i = 0; i < 4; i++) g[i] = 0;
        CHECK_EQUAL(0, dist_adam_step(&adam, 4, x, g));
        for (size_t i = 0; i < 4; i++) CHECK(test_finite((double)x[i]));
        for (size_t i = 0; i < 8; i++) CHECK(test_finite((double)moments[i]));
        if (t == 0) {
            CHECK_NEAR(0.99, x[0], 1e-6);
            CHECK_NEAR(1.01, x[1], 1e-6);
        }
    }
}

TEST(numbers_at_the_end_of_the_range_stay_in_it)
{
    float x[1] = {-3e38f}, d[1] = {0}, g[1] = {1}, moments[2] = {0, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    CHECK(test_finite((double)dist_loss_code(1, x, 1, d)) && test_finite((double)d[0]) && d[0] < 0);
    adam.moments = moments;
    adam.rate = 3e38f;
    CHECK_EQUAL(0, dist_adam_step(&adam, 1, x, g));
    CHECK(test_finite((double)x[0]) && x[0] < -3e38f);
    float normal[3] = {1e30f, 0, 0}, target[3] = {1, 0, 0};
    CHECK(test_finite((double)dist_loss_normal(1, normal, target, NULL, 1e30f, NULL)));
}

TEST(adam_skips_and_counts_what_is_not_finite)
{
    float x[3] = {1, 2, 3}, g[3] = {0, 0, 1}, moments[6] = {0.5f, 0.25f, 0, 0.5f, 0.25f, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    g[0] = loss_bits(0x7fc00000u);
    g[1] = loss_bits(0xff800000u);
    CHECK_EQUAL(2, dist_adam_step(&adam, 3, x, g));
    CHECK_NEAR(1, x[0], 0);
    CHECK_NEAR(2, x[1], 0);
    CHECK(x[2] < 3);
    CHECK_NEAR(0.5, moments[0], 0);
    CHECK_NEAR(0.25, moments[4], 0);
    for (int i = 0; i < 3; i++) x[i] = g[i] = 1.0f;
    moments[0] = moments[4] = loss_bits(0x7fc00000u); /* a checkpoint that is not what it was */
    CHECK_EQUAL(2, dist_adam_step(&adam, 3, x, g));
    CHECK_NEAR(1, x[0], 0);
    CHECK_NEAR(1, x[1], 0);
    CHECK(x[2] < 1 && x[2] > 0);
    memset(moments, 0, sizeof moments);
    x[1] = loss_bits(0x7fc00000u); /* a code that is lost already */
    CHECK_EQUAL(1, dist_adam_step(&adam, 3, x, g));
    CHECK(!test_finite((double)x[1]) && x[0] < 1);
    CHECK_NEAR(0, moments[1], 0);
    CHECK_NEAR(0, moments[4], 0);
}

TEST(adam_without_its_arrays_says_that_nothing_moved)
{
    float x[2] = {1, -2}, g[2] = {1, 1}, moments[4] = {0, 0, 0, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    CHECK_EQUAL(2, dist_adam_step(&adam, 2, x, g)); /* moments forgotten */
    CHECK_EQUAL(2, dist_adam_step(NULL, 2, x, g));
    adam.moments = moments;
    CHECK_EQUAL(2, dist_adam_step(&adam, 2, NULL, g));
    CHECK_EQUAL(2, dist_adam_step(&adam, 2, x, NULL));
    CHECK_EQUAL(0, adam.step);
    CHECK_EQUAL(0, dist_adam_step(&adam, 2, x, g));
    CHECK(x[0] < 1.0f);
}

TEST(adam_with_a_negative_rate_moves_nothing)
{
    float x[1] = {1}, g[1] = {5}, moments[2] = {0, 0};
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    adam.rate = -1.0f;
    dist_adam_step(&adam, 1, x, g);
    CHECK_NEAR(1, x[0], 0);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(losses_are_their_formulas);
    RUN(loss_gradients_are_central_differences);
    RUN(loss_gradients_are_added);
    RUN(depth_targets_that_are_not_seen_do_not_count);
    RUN(losses_over_nothing_are_zero_without_gradient);
    RUN(a_weight_that_is_not_finite_is_a_weight_of_zero);
    RUN(the_silhouette_of_wrong_pixels_does_not_fade);
    RUN(target_normals_are_normalized_and_zero_ones_left_out);
    RUN(a_million_small_terms_are_summed_without_loss);
    RUN(adam_is_its_formula_for_a_hundred_steps);
    RUN(adam_with_zero_gradients_never_moves);
    RUN(adam_with_a_rate_that_is_not_finite_never_moves);
    RUN(adam_stays_finite_for_huge_and_tiny_gradients);
    RUN(numbers_at_the_end_of_the_range_stay_in_it);
    RUN(adam_skips_and_counts_what_is_not_finite);
    RUN(adam_without_its_arrays_says_that_nothing_moved);
    RUN(adam_with_a_negative_rate_moves_nothing);
    return test_report();
}
