/* SPDX-License-Identifier: MIT-0
   Each kernel of each instruction set against the formula of section 03, computed in double.
   What a kernel has no business reading (unlisted rows, columns beyond the last, padding) is NaN, so that a value which
   leaks from there shows itself; what it has no business writing must keep its bytes. */
#include "test.h"

#include <float.h>

typedef struct test_size {
    int rows, out, columns;
} test_size;

static const int test_columns[] = {1, 2, 4, 5, 7, 8, 15, 16, 17, 31, 32, 33, 47, 48};

enum { TEST_COLUMNS = 14, TEST_CASES = 70 * TEST_COLUMNS + 7, TEST_BLOCK = DISTI_BLOCK, TEST_LONGEST = 700 };

/* All of 1..70 as rows and as outputs, each with all column counts, then inputs longer than a kernel takes at once. */
static test_size test_case(int n)
{
    static const int longer[7][3] = {{111, 9, 48}, {112, 16, 33}, {113, 70, 48}, {256, 8, 48},
                                     {300, 21, 17}, {9, 300, 48}, {700, 3, 48}};
    test_size size;
    if (n >= 70 * TEST_COLUMNS) {
        size.rows = longer[n - 70 * TEST_COLUMNS][0];
        size.out = longer[n - 70 * TEST_COLUMNS][1];
        size.columns = longer[n - 70 * TEST_COLUMNS][2];
        return size;
    }
    size.rows = n % 70 + 1;
    size.out = (n * 29 + n / 70) % 70 + 1;
    size.columns = test_columns[n / 70];
    return size;
}

static float test_nan(void)
{
    const uint32_t bits = 0x7fc00000u;
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

static test_allocator kernel_memory;

/* Aligned to 64 bytes and no more, NaN everywhere, with guards that test_free looks at. */
static float *floats(size_t n)
{
    float *p = (float *)test_alloc(&kernel_memory, n * sizeof(float), 64);
    for (size_t i = 0; i < n; i++) p[i] = test_nan();
    return p;
}

static void release(float *p, size_t n)
{
    test_free(&kernel_memory, p, n * sizeof(float));
}

/* rows of TEST_BLOCK with numbers in the first columns of the listed rows only (NULL: all) */
static float *block(test_random *random, int rows, int columns, const int *list, int list_count)
{
    float *p = floats((size_t)rows * TEST_BLOCK);
    for (int i = 0; i < (list ? list_count : rows); i++)
        test_random_fill(random, (size_t)columns, p + (list ? list[i] : i) * TEST_BLOCK, -1.0f, 1.0f);
    return p;
}

/* Ascending; empty now and then. */
static int random_list(test_random *random, int n, int *list)
{
    const int chance = test_random_int(random, 0, 5);
    int count = 0;
    for (int i = 0; i < n; i++)
        if (test_random_int(random, 1, 5) <= chance) list[count++] = i;
    return count;
}

static size_t packed(int rows, int o, int k)
{
    return ((size_t)(o / 8) * (size_t)rows + (size_t)k) * 8 + (size_t)(o % 8);
}

static int rounded(int out)
{
    return (out + 7) / 8 * 8;
}

/* The panels of all outputs; padded outputs have weight zero. */
static float *panels(test_random *random, int rows, int out)
{
    const size_t n = (size_t)rounded(out) * (size_t)rows;
    float *w = floats(n);
    memset(w, 0, n * sizeof(float));
    for (int o = 0; o < out; o++)
        for (int k = 0; k < rows; k++) w[packed(rows, o, k)] = test_random_float(random, -1.0f, 1.0f);
    return w;
}

/* n roundings of at most half an epsilon each, of partial sums up to `sum`; the rest is for terms in n squared. */
static double bound(int n, double sum)
{
    return (double)(n + 2) * (double)FLT_EPSILON * sum;
}

static void check_gemm_case(const disti_kernels *kernels, test_random *random, test_size size, int with_list,
                            int with_mask)
{
    const int padded = rounded(size.out);
    int list[TEST_LONGEST];
    uint64_t *mask = (uint64_t *)test_alloc(&kernel_memory, (size_t)padded * sizeof(uint64_t), 64);
    disti_gemm g;
    memset(&g, 0, sizeof g);
    g.rows = size.rows;
    g.out = size.out;
    g.columns = size.columns;
    g.alive = with_list ? list : NULL;
    g.alive_count = with_list ? random_list(random, size.rows, list) : 0;
    g.mask = with_mask ? mask : NULL;
    g.relu = test_random_int(random, 0, 1);
    float *weights = panels(random, size.rows, size.out), *bias = floats((size_t)padded);
    float *x = block(random, size.rows, size.columns, g.alive, g.alive_count), *y = floats((size_t)padded * TEST_BLOCK);
    test_random_fill(random, (size_t)padded, bias, -1.0f, 1.0f);
    g.weights = weights;
    g.bias = bias;
    g.x = x;
    g.y = y;
    kernels->gemm(&g);

    const int terms = with_list ? g.alive_count : size.rows;
    for (int o = 0; o < size.out; o++) {
        for (int c = 0; c < size.columns; c++) {
            double sum = (double)bias[o], size_sum = fabs(sum);
            for (int i = 0; i < terms; i++) {
                const int k = with_list ? list[i] : i;
                const double term = (double)weights[packed(size.rows, o, k)] * (double)x[k * TEST_BLOCK + c];
                sum += term;
                size_sum += fabs(term);
            }
            const float got = y[o * TEST_BLOCK + c];
            if ((with_mask || g.relu) && sum < 0) sum = 0;
            CHECK_NEAR(sum, got, bound(terms, size_sum));
            if (with_mask) CHECK((mask[o] >> c & 1) == (got > 0.0f));
        }
        if (with_mask) CHECK(mask[o] >> size.columns == 0);
    }
    test_free(&kernel_memory, mask, (size_t)padded * sizeof(uint64_t));
    release(weights, (size_t)padded * (size_t)size.rows);
    release(bias, (size_t)padded);
    release(x, (size_t)size.rows * TEST_BLOCK);
    release(y, (size_t)padded * TEST_BLOCK);
}

static void check_back_case(const disti_kernels *kernels, test_random *random, test_size size, int with_lists,
                            int with_mask)
{
    int out_list[300], row_list[TEST_LONGEST];
    uint64_t mask[TEST_LONGEST];
    disti_gemm_back g;
    memset(&g, 0, sizeof g);
    g.rows = size.rows;
    g.out = size.out;
    g.columns = size.columns;
    if (with_lists & 1) {
        g.alive_out = out_list;
        g.alive_out_count = random_list(random, size.out, out_list);
    }
    if (with_lists & 2) {
        g.alive_rows = row_list;
        g.alive_rows_count = random_list(random, size.rows, row_list);
    }
    const size_t d_x_size = (size_t)size.rows * TEST_BLOCK;
    float *weights = panels(random, size.rows, size.out);
    float *d_y = block(random, size.out, size.columns, g.alive_out, g.alive_out_count);
    float *d_x = floats(d_x_size), *before = floats(d_x_size);
    for (int k = 0; k < size.rows; k++) mask[k] = test_random_bits(random);
    g.weights = weights;
    g.d_y = d_y;
    g.d_x = d_x;
    g.mask = with_mask ? mask : NULL;
    kernels->gemm_back(&g);

    const int terms = g.alive_out ? g.alive_out_count : size.out;
    for (int k = 0, listed = 0; k < size.rows; k++) {
        if (g.alive_rows && !(listed < g.alive_rows_count && row_list[listed] == k)) {
            CHECK_BYTES(TEST_BLOCK * sizeof(float), before, d_x + k * TEST_BLOCK);
            continue;
        }
        listed++;
        for (int c = 0; c < size.columns; c++) {
            double sum = 0, size_sum = 0;
            for (int i = 0; i < terms; i++) {
                const int o = g.alive_out ? out_list[i] : i;
                const double term = (double)weights[packed(size.rows, o, k)] * (double)d_y[o * TEST_BLOCK + c];
                sum += term;
                size_sum += fabs(term);
            }
            if (with_mask && !(mask[k] >> c & 1)) sum = size_sum = 0;
            CHECK_NEAR(sum, d_x[k * TEST_BLOCK + c], bound(terms, size_sum));
        }
    }
    release(weights, (size_t)rounded(size.out) * (size_t)size.rows);
    release(d_y, (size_t)size.out * TEST_BLOCK);
    release(d_x, d_x_size);
    release(before, d_x_size);
}

/* d_weights begins off any alignment, and its rows are `gap` floats further apart than they are long. */
static void check_weights_case(const disti_kernels *kernels, test_random *random, test_size size, int gap)
{
    const size_t rows = (size_t)size.rows, columns = (size_t)size.columns;
    disti_gemm_weights g;
    memset(&g, 0, sizeof g);
    g.rows = size.rows;
    g.out = size.out;
    g.columns = size.columns;
    g.stride = rows + (size_t)gap;
    g.xt_stride = (rows + 15) / 16 * 16 + (gap & 1 ? 16u : 0u);
    const size_t n = 1 + ((size_t)size.out - 1) * g.stride + rows;
    float *d_y = block(random, size.out, size.columns, NULL, 0), *xt = floats(columns * g.xt_stride);
    float *d_weights = floats(n), *before = floats(n);
    for (size_t c = 0; c < columns; c++) test_random_fill(random, rows, xt + c * g.xt_stride, -1.0f, 1.0f);
    for (size_t o = 0; o < (size_t)size.out; o++)
        test_random_fill(random, rows, d_weights + 1 + o * g.stride, -1.0f, 1.0f);
    memcpy(before, d_weights, n * sizeof(float));
    g.d_y = d_y;
    g.xt = xt;
    g.d_weights = d_weights + 1;
    kernels->gemm_weights(&g);

    CHECK_BYTES(sizeof(float), before, d_weights);
    for (size_t o = 0; o < (size_t)size.out; o++) {
        const size_t row = 1 + o * g.stride;
        for (size_t k = 0; k < rows; k++) {
            double sum = (double)before[row + k], size_sum = fabs(sum);
            for (size_t c = 0; c < columns; c++) {
                const double term = (double)d_y[o * TEST_BLOCK + c] * (double)xt[c * g.xt_stride + k];
                sum += term;
                size_sum += fabs(term);
            }
            CHECK_NEAR(sum, d_weights[row + k], bound(size.columns, size_sum));
        }
        const size_t after = o + 1 < (size_t)size.out ? (size_t)gap : 0;
        CHECK_BYTES(after * sizeof(float), before + row + rows, d_weights + row + rows);
    }
    release(d_y, (size_t)size.out * TEST_BLOCK);
    release(xt, columns * g.xt_stride);
    release(d_weights, n);
    release(before, n);
}

static void check_dot_case(const disti_kernels *kernels, test_random *random, test_size size, int with_list)
{
    int list[TEST_LONGEST];
    const int *alive = with_list ? list : NULL;
    const int count = with_list ? random_list(random, size.rows, list) : size.rows;
    float *w = floats((size_t)size.rows), *y = floats(TEST_BLOCK);
    float *x = block(random, size.rows, size.columns, alive, count);
    const float bias = test_random_float(random, -1.0f, 1.0f);
    for (int i = 0; i < count; i++) w[alive ? alive[i] : i] = test_random_float(random, -1.0f, 1.0f);
    kernels->dot(w, bias, x, alive, count, size.rows, size.columns, y);
    for (int c = 0; c < size.columns; c++) {
        double sum = (double)bias, size_sum = fabs(sum);
        for (int i = 0; i < count; i++) {
            const int k = alive ? alive[i] : i;
            const double term = (double)w[k] * (double)x[k * TEST_BLOCK + c];
            sum += term;
            size_sum += fabs(term);
        }
        CHECK_NEAR(sum, y[c], bound(count, size_sum));
    }
    release(w, (size_t)size.rows);
    release(x, (size_t)size.rows * TEST_BLOCK);
    release(y, TEST_BLOCK);
}

static void check_outer_case(const disti_kernels *kernels, test_random *random, test_size size, int with_list,
                             int with_mask)
{
    int list[TEST_LONGEST];
    uint64_t mask[TEST_LONGEST];
    const int *alive = with_list ? list : NULL;
    const int count = with_list ? random_list(random, size.rows, list) : size.rows;
    const size_t n = (size_t)size.rows * TEST_BLOCK;
    float *w = floats((size_t)size.rows), *s = block(random, 1, size.columns, NULL, 0);
    float *y = floats(n), *before = floats(n);
    test_random_fill(random, (size_t)size.rows, w, -1.0f, 1.0f);
    for (int k = 0; k < size.rows; k++) mask[k] = test_random_bits(random);
    kernels->outer(w, s, alive, count, size.rows, size.columns, with_mask ? mask : NULL, y);
    for (int k = 0, listed = 0; k < size.rows; k++) {
        if (alive && !(listed < count && list[listed] == k)) {
            CHECK_BYTES(TEST_BLOCK * sizeof(float), before, y + k * TEST_BLOCK);
            continue;
        }
        listed++;
        for (int c = 0; c < size.columns; c++) {
            const double product = with_mask && !(mask[k] >> c & 1) ? 0.0 : (double)w[k] * (double)s[c];
            CHECK_NEAR(product, y[k * TEST_BLOCK + c], bound(0, fabs(product)));
        }
    }
    release(w, (size_t)size.rows);
    release(s, TEST_BLOCK);
    release(y, n);
    release(before, n);
}

static void check_lanes_case(const disti_kernels *kernels, test_random *random, test_size size, int with_list)
{
    int list[TEST_LONGEST];
    const int *alive = with_list ? list : NULL;
    const int count = with_list ? random_list(random, size.rows, list) : size.rows;
    const size_t n = (size_t)size.rows * 16;
    float *x = block(random, size.rows, size.columns, alive, count), *s = block(random, 1, size.columns, NULL, 0);
    float *sum = floats(n), *before = floats(n);
    test_random_fill(random, n, before, -1.0f, 1.0f);
    memcpy(sum, before, n * sizeof *sum);
    kernels->lanes(s, x, alive, count, size.rows, size.columns, sum);
    for (int k = 0, listed = 0; k < size.rows; k++) {
        double expected = 0, got = 0, size_sum = 0;
        if (alive && !(listed < count && list[listed] == k)) {
            CHECK_BYTES(16 * sizeof *sum, before + 16 * k, sum + 16 * k);
            continue;
        }
        listed++;
        for (int i = 0; i < 16; i++) {
            expected += (double)before[16 * k + i];
            got += (double)sum[16 * k + i];
            size_sum += fabs((double)before[16 * k + i]);
        }
        for (int c = 0; c < size.columns; c++) {
            const double term = (double)s[c] * (double)x[k * TEST_BLOCK + c];
            expected += term;
            size_sum += fabs(term);
        }
        CHECK_NEAR(expected, got, bound(size.columns + 16, size_sum));
    }
    release(x, (size_t)size.rows * TEST_BLOCK);
    release(s, TEST_BLOCK);
    release(sum, n);
    release(before, n);
}

/* Rows of points and back, and y + s x in double. */
static void check_points_case(const disti_kernels *kernels, test_random *random, test_size size)
{
    float *points = floats(3 * TEST_BLOCK), *rows = floats(3 * TEST_BLOCK), *back = floats(3 * TEST_BLOCK);
    double y[TEST_LONGEST];
    float x[TEST_LONGEST];
    test_random_fill(random, 3 * TEST_BLOCK, points, -1.0f, 1.0f);
    kernels->rows(points, rows);
    for (int i = 0; i < 3 * TEST_BLOCK; i++)
        CHECK_BYTES(sizeof *rows, points + i, rows + i % 3 * TEST_BLOCK + i / 3);
    kernels->points(rows, back);
    CHECK_BYTES(3 * TEST_BLOCK * sizeof *points, points, back);
    test_random_fill(random, (size_t)size.rows, x, -1.0f, 1.0f);
    for (int i = 0; i < size.rows; i++) y[i] = 1.0 / (i + 1);
    kernels->axpy((size_t)size.rows, 0.3, x, y);
    for (int i = 0; i < size.rows; i++) CHECK_NEAR(1.0 / (i + 1) + 0.3 * (double)x[i], y[i], 1e-15);
    release(points, 3 * TEST_BLOCK);
    release(rows, 3 * TEST_BLOCK);
    release(back, 3 * TEST_BLOCK);
}

/* ReLU with its bits, every activation with its slope, LayerNorm and its adjoint, against the scalar kernels,
   which test_net and test_gradients hold against the formulas. */
static void check_plain_case(const disti_kernels *kernels, test_random *random, test_size size)
{
    const disti_kernels scalar = disti_kernels_for(DIST_ISA_SCALAR);
    const size_t n = (size_t)size.rows * TEST_BLOCK, rows = (size_t)size.rows;
    float *x = floats(n), *a = floats(n), *b = floats(n), *slope_a = floats(n), *slope_b = floats(n);
    float *gamma = floats(rows), *beta = floats(rows), inverse[2][TEST_BLOCK];
    uint64_t mask[2][TEST_LONGEST];
    test_random_fill(random, n, x, -4.0f, 4.0f);
    test_random_fill(random, rows, gamma, -1.0f, 1.0f);
    test_random_fill(random, rows, beta, -1.0f, 1.0f);
    memcpy(a, x, n * sizeof *x);
    memcpy(b, x, n * sizeof *x);
#ifndef __FAST_MATH__
    a[n / 2] = b[n / 2] = test_nan();
#endif
    scalar.relu(rows, a, mask[0]);
    kernels->relu(rows, b, mask[1]);
    CHECK_BYTES(n * sizeof *x, a, b);
    CHECK_BYTES(rows * sizeof **mask, mask[0], mask[1]);
    for (int activation = DIST_ACTIVATION_RELU; activation <= DIST_ACTIVATION_NONE; activation++) {
        const float scale = activation == DIST_ACTIVATION_SINE ? 30.0f : 2.0f;
        for (int slopes = 0; slopes < 2; slopes++) {
            memcpy(a, x, n * sizeof *x);
            memcpy(b, x, n * sizeof *x);
            a[0] = b[0] = 200.0f; /* where exp overflows */
            a[1] = b[1] = -200.0f;
            scalar.activate(activation, scale, n, a, slopes ? slope_a : NULL);
            kernels->activate(activation, scale, n, b, slopes ? slope_b : NULL);
            CHECK_NEAR_ARRAY(n, a, b, 2e-6);
            if (slopes) CHECK_NEAR_ARRAY(n, slope_a, slope_b, 2e-6 * (double)scale);
        }
#ifndef __FAST_MATH__
        memcpy(a, x, n * sizeof *x);
        kernels->activate(activation, scale, n, a, NULL);
        CHECK_BYTES((n - 2) * sizeof *x, a + 2, b + 2); /* with its slope and without */
#endif
    }
    for (int activation = DIST_ACTIVATION_RELU; activation <= DIST_ACTIVATION_NONE; activation++) {
        const float scale = activation == DIST_ACTIVATION_SINE ? 30.0f : 2.0f;
        memcpy(a, x, n * sizeof *x);
        memcpy(b, x, n * sizeof *x);
        memset(mask, 0, sizeof mask);
        scalar.activate_tangents(activation, scale, rows, a, slope_a, mask[0]);
        kernels->activate_tangents(activation, scale, rows, b, slope_b, mask[1]);
        CHECK_NEAR_ARRAY(n, a, b, 1e-5 * (double)scale);
        CHECK_NEAR_ARRAY(n, slope_a, slope_b, 1e-5 * (double)(scale * scale));
        CHECK_BYTES(rows * sizeof **mask, mask[0], mask[1]);
        kernels->activate_tangents(activation, scale, rows, memcpy(a, x, n * sizeof *x), NULL, mask[0]);
        CHECK_BYTES(n * sizeof *x, a, b);
        for (size_t half = 0; half <= TEST_BLOCK / 2; half += TEST_BLOCK / 2) {
            memcpy(a, x, n * sizeof *x);
            memcpy(b, x, n * sizeof *x);
            scalar.activate_back(rows, half, slope_a, a);
            kernels->activate_back(rows, half, slope_a, b);
            CHECK_NEAR_ARRAY(n, a, b, 1e-5 * (double)(scale * scale));
        }
    }
    if (rows >= 16) {
        const float *from[16];
        const size_t stride = 16 + (size_t)test_random_int(random, 0, 5);
        float to[TEST_BLOCK * 21];
        for (size_t k = 0; k < 16; k++) from[k] = x + (k * 7 % 16) * TEST_BLOCK;
        for (size_t i = 0; i < TEST_BLOCK * 21; i++) to[i] = 7.0f;
        kernels->transpose(from, 0.3f, to, stride);
        for (size_t i = 0; i < TEST_BLOCK * stride; i++)
            CHECK_NEAR(i % stride < 16 ? 0.3 * (double)from[i % stride][i / stride] : 7.0, to[i], 3e-7);
    }
    CHECK(!kernels->huge(0, x) && !kernels->huge(n, x));
    for (int i = 0; i < 8; i++) {
        size_t at = (size_t)test_random_int(random, 0, (int)n - 1);
        float kept = x[at];
        x[at] = i % 2 ? 7.3e16f : -7.3e16f;
        CHECK(kernels->huge(at + 1, x) && !kernels->huge(at, x));
        x[at] = i % 2 ? 7.1e16f : -7.1e16f;
        CHECK(!kernels->huge(n, x));
        x[at] = test_nan();
        CHECK(kernels->huge(n, x));
        x[at] = kept;
    }
    memcpy(a, x, n * sizeof *x);
    memcpy(b, x, n * sizeof *x);
    scalar.norm_tangents(size.rows, 1e-2f, gamma, beta, a, slope_a, inverse[0]);
    kernels->norm_tangents(size.rows, 1e-2f, gamma, beta, b, slope_b, inverse[1]);
    CHECK_NEAR_ARRAY(n, a, b, 1e-3);
    CHECK_NEAR_ARRAY(n, slope_a, slope_b, 1e-3);
    CHECK_NEAR_ARRAY(TEST_BLOCK, inverse[0], inverse[1], 1e-3);
    memcpy(a, x, n * sizeof *x);
    memcpy(b, x, n * sizeof *x);
    scalar.norm(size.rows, 1e-2f, gamma, beta, a, slope_a, inverse[0]);
    kernels->norm(size.rows, 1e-2f, gamma, beta, b, slope_b, inverse[1]);
    CHECK_NEAR_ARRAY(n, a, b, 2e-5);
    CHECK_NEAR_ARRAY(n, slope_a, slope_b, 2e-5);
    for (size_t half = 0; half <= TEST_BLOCK / 2; half += TEST_BLOCK / 2) {
        test_random_fill(random, n, a, -1.0f, 1.0f);
        memcpy(b, a, n * sizeof *a);
        scalar.norm_back(size.rows, gamma, half, slope_a, inverse[0], a);
        kernels->norm_back(size.rows, gamma, half, slope_a, inverse[0], b);
        CHECK_NEAR_ARRAY(n, a, b, 1e-3); /* one row: divided by sigma = 0.1 twice and more */
    }
    float angle_a[4 * TEST_BLOCK], angle_b[4 * TEST_BLOCK]; /* two levels of sines and cosines, each beside the other */
    scalar.angles(3.14159265, 2, x, 2 * TEST_BLOCK, angle_a, angle_a + TEST_BLOCK);
    kernels->angles(3.14159265, 2, x, 2 * TEST_BLOCK, angle_b, angle_b + TEST_BLOCK);
    CHECK_NEAR_ARRAY(4 * TEST_BLOCK, angle_a, angle_b, 1.2e-7);
    for (int c = 0; c < TEST_BLOCK; c++) {
        CHECK_NEAR(sin(3.14159265 * (double)x[c]), angle_a[c], 1.2e-7);
        CHECK_NEAR(cos(2 * 3.14159265 * (double)x[c]), angle_a[3 * TEST_BLOCK + c], 1.2e-7);
    }
    release(x, n);
    release(a, n);
    release(b, n);
    release(slope_a, n);
    release(slope_b, n);
    release(gamma, rows);
    release(beta, rows);
}

/* What bounds of units are made of: the models of rows, their sums for every output, and which units may be alive. */
static void check_bounds_case(const disti_kernels *kernels, test_random *random, test_size size)
{
    enum { BLOCKS = 2 };
    const int padded = rounded(size.out), columns = (size.columns + 15) / 16 * 16;
    const size_t stride = (size_t)(size.rows > padded ? size.rows : padded), sums = BLOCKS * 5 * stride;
    int list[BLOCKS * TEST_LONGEST], count[BLOCKS], live[TEST_LONGEST];
    float *weights = panels(random, size.rows, size.out), *bias = floats(stride), *slopes = floats(5 * stride);
    float *model = floats(BLOCKS * stride * 8), *sum = floats(sums), *d = floats(3 * TEST_BLOCK), *x[BLOCKS];
    uint64_t mask[TEST_LONGEST];
    disti_fit fit;
    test_random_fill(random, stride, bias, -1.0f, 1.0f);
    test_random_fill(random, 5 * stride, slopes, -1.0f, 1.0f);
    for (size_t k = 0; k < 3; k++) test_random_fill(random, (size_t)columns, d + k * TEST_BLOCK, -0.5f, 0.5f);
    for (int k = 0; k < size.rows; k++) mask[k] = (k % 3 ? ((uint64_t)1 << columns) : (uint64_t)2) - 1;
    fit.d = d;
    fit.sum = slopes;
    fit.mask = mask;
    fit.stride = stride;
    fit.half[0] = fit.half[1] = fit.half[2] = 0.5f;
    fit.slack = 1e-5f;
    fit.columns = columns;
    for (int b = 0; b < BLOCKS; b++) {
        count[b] = random_list(random, size.rows, list + b * TEST_LONGEST);
        x[b] = block(random, size.rows, columns, list + b * TEST_LONGEST, count[b]);
        fit.list = list + b * TEST_LONGEST;
        fit.x = x[b];
        fit.model = model + (size_t)b * stride * 8;
        fit.count = count[b];
        kernels->fit(&fit);
        for (int i = 0; i < count[b]; i++) {
            const int row = fit.list[i];
            const float *m = fit.model + 8 * i;
            double least = 1e9, most = -1e9;
            const float factor = row % 3 ? 1.0f : 0.5f; /* as the mask has it */
            for (int k = 1; k < 4; k++)
                CHECK_NEAR((double)(factor * slopes[(size_t)k * stride + (size_t)row]), m[k], 0);
            for (int c = 0; c < columns; c++) {
                double r = (double)x[b][row * TEST_BLOCK + c] - (double)m[0];
                for (int k = 0; k < 3; k++) r -= (double)m[1 + k] * (double)d[k * TEST_BLOCK + c];
                least = fmin(least, r);
                most = fmax(most, r);
            }
            CHECK(fmax(most, -least) <= (double)m[4]);
            CHECK((double)m[4] <= 0.5 * (most - least) + 1e-4);
        }
    }
    disti_bound g;
    g.weights = weights;
    g.list = list;
    g.count = count;
    g.model = model;
    g.sum = sum;
    g.stride = stride;
    g.list_stride = TEST_LONGEST;
    g.rows = size.rows;
    g.out = size.out;
    g.blocks = BLOCKS;
    kernels->bound(&g);
    float cell[6 * DISTI_CELLS];
    test_random_fill(random, 6 * DISTI_CELLS, cell, 0.0f, 0.5f);
    for (int b = 0; b < BLOCKS; b++) {
        const float *got = sum + (size_t)b * 5 * stride;
        kernels->live((size_t)size.out, got, stride, bias, fit.slack, cell, live);
        for (int o = 0; o < size.out; o++) {
            double exact[5] = {0, 0, 0, 0, 0}, size_sum[5] = {0, 0, 0, 0, 0}, most = -1e9;
            for (int i = 0; i < count[b]; i++) {
                const float *m = model + ((size_t)b * stride + (size_t)i) * 8;
                double w = (double)weights[packed(size.rows, o, list[b * TEST_LONGEST + i])];
                for (int k = 0; k < 5; k++) exact[k] += (k < 4 ? w : fabs(w)) * (double)m[k];
                for (int k = 0; k < 5; k++) size_sum[k] += fabs(w * (double)m[k]);
            }
            for (int k = 0; k < 5; k++)
                CHECK_NEAR(exact[k], got[(size_t)k * stride + (size_t)o], bound(count[b], size_sum[k]));
            for (int i = 0; i < 6 * DISTI_CELLS; i += 6) {
                double t = 0;
                for (int k = 0; k < 3; k++)
                    t += exact[1 + k] * (double)cell[i + k] + fabs(exact[1 + k]) * (double)cell[i + 3 + k];
                most = fmax(most, t);
            }
            most += exact[0] + exact[4] + (double)bias[o];
            if (fabs(most) > 2e-5 + bound(count[b], 8 * (size_sum[0] + size_sum[1] + size_sum[2] + size_sum[3])))
                CHECK_EQUAL(most > 0, live[o]);
        }
    }
    release(weights, (size_t)padded * (size_t)size.rows);
    release(bias, stride);
    release(slopes, 5 * stride);
    release(model, BLOCKS * stride * 8);
    release(sum, sums);
    release(d, 3 * TEST_BLOCK);
    for (int b = 0; b < BLOCKS; b++) release(x[b], (size_t)size.rows * TEST_BLOCK);
}

typedef struct test_result {
    float y[72 * TEST_BLOCK];
    float dot[TEST_BLOCK];
    uint64_t mask[72];
} test_result;

static void run_forward(const disti_kernels *kernels, disti_gemm *g, int use_mask, float *y, test_result *result)
{
    memset(result, 0, sizeof *result);
    g->y = y;
    g->mask = use_mask ? result->mask : NULL;
    kernels->gemm(g);
    for (int o = 0; o < g->out; o++)
        memcpy(result->y + o * TEST_BLOCK, y + o * TEST_BLOCK, (size_t)g->columns * sizeof(float));
    kernels->dot(g->weights, g->bias[0], g->x, g->alive, g->alive_count, g->rows, g->columns, y);
    memcpy(result->dot, y, (size_t)g->columns * sizeof(float));
}

/* Zero rows left out by a list, and then fewer columns: nothing but what is left out may change. */
static void check_same_bits(const disti_kernels *kernels, test_random *random, test_size size, int leave_out,
                            int use_mask)
{
    static test_result all, some;
    int list[TEST_LONGEST];
    const int padded = rounded(size.out), count = random_list(random, size.rows, list);
    disti_gemm g;
    memset(&g, 0, sizeof g);
    g.rows = size.rows;
    g.out = size.out;
    g.columns = leave_out ? size.columns : TEST_BLOCK;
    float *weights = panels(random, size.rows, size.out), *bias = floats((size_t)padded);
    float *x = block(random, size.rows, TEST_BLOCK, NULL, 0), *y = floats((size_t)padded * TEST_BLOCK);
    memset(bias, 0, (size_t)padded * sizeof(float));
    for (int o = 1; o < size.out; o++) bias[o] = test_random_float(random, -1.0f, 1.0f);
#ifndef __FAST_MATH__
    bias[0] = -0.0f; /* with that flag the sign of zero is the compiler's */
#endif
    for (int k = 0, i = 0; k < size.rows && leave_out; k++) {
        if (i < count && list[i] == k) i++;
        else memset(x + k * TEST_BLOCK, 0, TEST_BLOCK * sizeof(float));
    }
    g.weights = weights;
    g.bias = bias;
    g.x = x;
    run_forward(kernels, &g, use_mask, y, &all);
    if (leave_out) {
        g.alive = list;
        g.alive_count = count;
    } else {
        g.columns = size.columns;
    }
    run_forward(kernels, &g, use_mask, y, &some);
    for (int o = 0; o < size.out; o++) {
        const uint64_t kept = ((uint64_t)1 << size.columns) - 1;
        CHECK_BYTES((size_t)size.columns * sizeof(float), all.y + o * TEST_BLOCK, some.y + o * TEST_BLOCK);
        CHECK((all.mask[o] & kept) == some.mask[o]);
    }
    CHECK_BYTES((size_t)size.columns * sizeof(float), all.dot, some.dot);
    release(weights, (size_t)padded * (size_t)size.rows);
    release(bias, (size_t)padded);
    release(x, (size_t)size.rows * TEST_BLOCK);
    release(y, (size_t)padded * TEST_BLOCK);
}

enum { GEMM, BACK, WEIGHTS, DOT, OUTER, LANES, PLAIN, BOUNDS, ZERO_ROWS, FEWER_COLUMNS };

static void check_all_sizes(int isa, int what)
{
    if (!test_cpu_has(isa)) SKIP("this processor or build lacks the instruction set");
    const disti_kernels kernels = disti_kernels_for(isa);
    test_random random = test_random_seed(3);
    memset(&kernel_memory, 0, sizeof kernel_memory);
    for (int n = 0; n < TEST_CASES; n += test_quick() ? 7 : 1) {
        const test_size size = test_case(n);
        for (int variant = 0; variant < 4; variant++) {
            if (what == GEMM) check_gemm_case(&kernels, &random, size, variant & 1, variant >> 1);
            if (what == BACK) check_back_case(&kernels, &random, size, variant, n & 1);
            if (what == WEIGHTS && variant < 2) check_weights_case(&kernels, &random, size, variant * (n % 7));
            if (what == DOT && variant < 2) check_dot_case(&kernels, &random, size, variant);
            if (what == OUTER) check_outer_case(&kernels, &random, size, variant & 1, variant >> 1);
            if (what == LANES && variant < 2) check_lanes_case(&kernels, &random, size, variant);
            if (what == LANES && variant == 2) check_points_case(&kernels, &random, size);
            if (what == PLAIN && variant == 0 && n % 7 == 0) check_plain_case(&kernels, &random, size);
            if (what == BOUNDS && variant == 0) check_bounds_case(&kernels, &random, size);
            if (size.out > 70) continue;
            if (what == ZERO_ROWS && variant < 2) check_same_bits(&kernels, &random, size, 1, variant);
            if (what == FEWER_COLUMNS && variant < 2) check_same_bits(&kernels, &random, size, 0, variant);
        }
    }
    CHECK_EQUAL(0, kernel_memory.live_blocks);
    CHECK_EQUAL(0, kernel_memory.errors);
}

/* Guard zones and rows that are not listed are looked at in all of them. */
#define TEST_KERNELS(name, isa)                                                                             \
    TEST(gemm_of_##name##_is_its_formula) { check_all_sizes(isa, GEMM); }                                   \
    TEST(gemm_back_of_##name##_is_its_formula_and_writes_listed_rows_only) { check_all_sizes(isa, BACK); }  \
    TEST(gemm_weights_of_##name##_is_its_formula_and_leaves_gaps_alone) { check_all_sizes(isa, WEIGHTS); }  \
    TEST(dot_of_##name##_is_its_formula) { check_all_sizes(isa, DOT); }                                     \
    TEST(outer_of_##name##_is_its_formula_and_writes_listed_rows_only) { check_all_sizes(isa, OUTER); }     \
    TEST(sums_over_lanes_and_points_of_##name##_are_their_formulas) { check_all_sizes(isa, LANES); }        \
    TEST(element_by_element_##name##_does_what_scalar_does) { check_all_sizes(isa, PLAIN); }                \
    TEST(bounds_of_units_of_##name##_hold) { check_all_sizes(isa, BOUNDS); }                                \
    TEST(leaving_out_zero_rows_changes_no_bit_with_##name) { check_all_sizes(isa, ZERO_ROWS); }             \
    TEST(a_column_does_not_depend_on_their_number_with_##name) { check_all_sizes(isa, FEWER_COLUMNS); }

#define RUN_KERNELS(name)                                            \
    RUN(gemm_of_##name##_is_its_formula);                            \
    RUN(gemm_back_of_##name##_is_its_formula_and_writes_listed_rows_only); \
    RUN(gemm_weights_of_##name##_is_its_formula_and_leaves_gaps_alone); \
    RUN(dot_of_##name##_is_its_formula);                             \
    RUN(outer_of_##name##_is_its_formula_and_writes_listed_rows_only); \
    RUN(sums_over_lanes_and_points_of_##name##_are_their_formulas);  \
    RUN(element_by_element_##name##_does_what_scalar_does);          \
    RUN(bounds_of_units_of_##name##_hold);                           \
    RUN(leaving_out_zero_rows_changes_no_bit_with_##name);           \
    RUN(a_column_does_not_depend_on_their_number_with_##name)

TEST_KERNELS(scalar, DIST_ISA_SCALAR)
TEST_KERNELS(sse2, DIST_ISA_SSE2)
TEST_KERNELS(avx2, DIST_ISA_AVX2)
TEST_KERNELS(avx512, DIST_ISA_AVX512)
TEST_KERNELS(neon, DIST_ISA_NEON)

TEST(the_processor_is_recognized_as_the_compiler_does_it)
{
    for (int isa = DIST_ISA_SCALAR; isa <= DIST_ISA_NEON; isa++)
        CHECK_EQUAL(test_cpu_has(isa) != 0, disti_cpu_has(isa));
    CHECK(!disti_cpu_has(DIST_ISA_NEON + 1));
    CHECK(!disti_cpu_has(-1));
}

TEST(the_best_instruction_set_is_the_last_that_the_processor_has)
{
    int best = DIST_ISA_SCALAR;
    for (int isa = DIST_ISA_SCALAR; isa <= DIST_ISA_NEON; isa++)
        if (disti_cpu_has(isa)) best = isa;
    CHECK_EQUAL(best, disti_cpu_best());
}

TEST(spans_are_what_spheres_cover_of_another_line)
{
    enum { COUNT = 12 };
    test_random random = test_random_seed(5);
    for (int round = 0; round < 200; round++) {
        float s[COUNT], square[COUNT], line[5], from[COUNT], to[COUNT];
        double e[3], w[3], v[3] = {0.6, 0, 0.8}, along_e = 0, along_w = 0, part[5] = {0, 0, 0, 0, 0};
        for (int i = 0; i < 3; i++) {
            e[i] = test_random_double(&random, -0.3, 0.3);
            w[i] = test_random_double(&random, -0.1, 0.1);
            along_e += e[i] * v[i];
            along_w += w[i] * v[i];
        }
        for (int i = 0; i < 3; i++) {
            double a = e[i] - along_e * v[i], b = w[i] - along_w * v[i];
            part[2] += a * a;
            part[3] += 2 * a * b;
            part[4] += b * b;
        }
        part[0] = along_e;
        part[1] = along_w;
        for (int i = 0; i < 5; i++) line[i] = (float)part[i];
        test_random_fill(&random, COUNT, s, -1.0f, 1.0f);
        test_random_fill(&random, COUNT, square, 0.0f, 0.2f);
        square[COUNT - 1] = 0;
        disti_spans(s, square, COUNT, line, from, to);
        CHECK(from[COUNT - 1] > 2e38f || part[2] < 1e-6);
        for (int k = 0; k < COUNT; k++) { /* the ends lie on the sphere about e + s (v + w) */
            for (int end = 0; end < 2 && from[k] < 2e38f; end++) {
                double at = end ? (double)to[k] : (double)from[k], distance = 0;
                for (int i = 0; i < 3; i++) {
                    double d = e[i] + (double)s[k] * (v[i] + w[i]) - at * v[i];
                    distance += d * d;
                }
                CHECK_NEAR((double)square[k], distance, 1e-5);
            }
            double p = (double)s[k], off = part[2] + p * (part[3] + p * part[4]);
            CHECK((from[k] > 2e38f) == (off > (double)square[k]) || fabs(off - (double)square[k]) < 1e-6);
        }
        float next, first = 3e38f, most = -0.4f, end = disti_spans_end(from, to, COUNT, -0.4f, &next);
        for (int pass = 0; pass < COUNT; pass++)
            for (int k = 0; k < COUNT; k++)
                if (from[k] <= most && to[k] > most) most = to[k];
        for (int k = 0; k < COUNT; k++)
            if (from[k] > most && from[k] < first) first = from[k];
        CHECK_NEAR((double)most, end, 0);
        CHECK_NEAR((double)first, next, 0);
    }
}

static void run_kernels(void)
{
    RUN(spans_are_what_spheres_cover_of_another_line);
    RUN(the_processor_is_recognized_as_the_compiler_does_it);
    RUN(the_best_instruction_set_is_the_last_that_the_processor_has);
    RUN_KERNELS(scalar);
    RUN_KERNELS(sse2);
    RUN_KERNELS(avx2);
    RUN_KERNELS(avx512);
    RUN_KERNELS(neon);
}
