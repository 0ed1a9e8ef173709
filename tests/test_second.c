/* SPDX-License-Identifier: MIT-0
   test_second.c - second derivatives of fields: u . grad f and its gradients, the normals' and the eikonal term's

   The equations of dist.h are written once more in double (second_run) and held against central differences in double
   to 1e-6; the library, in float, is held against them. */
#include "test.h"

#include "model.h"

/* ---- s = u . grad f and its gradients in double ------------------------------------------------------------------ */

typedef struct second_layer {
    int n; /* columns */
    double x[MODEL_WIDTH], xt[MODEL_WIDTH];         /* input and its tangent */
    double slope[MODEL_WIDTH], bend[MODEL_WIDTH];   /* phi'(a), phi''(a) a' */
    double hat[MODEL_WIDTH], hat_t[MODEL_WIDTH], sigma, along; /* along: mean(hat x') */
    double d[MODEL_WIDTH], dt[MODEL_WIDTH];         /* gradients of the pre-activation and its tangent */
} second_layer;

typedef struct second_gradients {
    double point[3], code[MODEL_CODE], *params;
} second_gradients;

/* Axis, frequency (0: the point itself) and whether it is a cosine, of every number of the encoded point. */
static int second_encoding(const model *m, int axis[], double frequency[], int cosine[])
{
    const model_desc *d = &m->desc;
    int n = 0, levels = d->fourier ? d->levels : 0;
    double base = d->base > 0.0 ? d->base : 3.14159265358979323846;
    for (int i = 0; i < 3 && !(d->fourier && d->no_raw); i++, n++) axis[n] = i, frequency[n] = 0.0, cosine[n] = 0;
    for (int j = 0; j < 2 * levels; j++) {
        int k = d->order == MODEL_SIN_COS ? j / 2 : j % levels;
        int second_half = d->order == MODEL_SIN_COS ? j % 2 : j / levels;
        for (int i = 0; i < 3; i++, n++) {
            axis[n] = i;
            frequency[n] = ldexp(base, k);
            cosine[n] = d->order == MODEL_COS_ALL ? !second_half : second_half;
        }
    }
    return n;
}

static void second_activation(const model *m, int l, double x, double *v, double *d, double *dd)
{
    double scale = l == 0 ? m->desc.first_scale : m->desc.scale, e;
    *v = model_activate(m, l, x);
    *d = 1.0;
    *dd = 0.0;
    switch (m->desc.activation) {
    case DIST_ACTIVATION_RELU: *d = x > 0.0 ? 1.0 : 0.0; break;
    case DIST_ACTIVATION_ELU:
        *d = x > 0.0 ? 1.0 : exp(x);
        *dd = x > 0.0 ? 0.0 : exp(x);
        break;
    case DIST_ACTIVATION_SOFTPLUS:
        e = 1.0 / (1.0 + exp(-scale * x));
        *d = e;
        *dd = scale * e * (1.0 - e);
        break;
    case DIST_ACTIVATION_SINE:
        *d = scale * cos(scale * x);
        *dd = -scale * scale * sin(scale * x);
        break;
    case DIST_ACTIVATION_TANH:
        *d = 1.0 - *v * *v;
        *dd = -2.0 * *v * *d;
        break;
    }
}

/* Value and first two derivatives of the output function. */
static void second_output(const model *m, double x, double *v, double *d, double *dd)
{
    double t = tanh(x), s = 1.0 - t * t, b = -2.0 * t * s;
    *v = x, *d = 1.0, *dd = 0.0;
    if (m->desc.output == MODEL_TANH) *v = t, *d = s, *dd = b;
    if (m->desc.output == MODEL_TANH_TWICE) {
        double q = tanh(t), qs = 1.0 - q * q;
        *v = q, *d = qs * s, *dd = -2.0 * q * qs * s * s + qs * b;
    }
    if (m->desc.output == MODEL_SIGMOID) {
        *v = 1.0 / (1.0 + exp(-x));
        *d = *v * (1.0 - *v);
        *dd = *d * (1.0 - 2.0 * *v);
    }
}

/* Returns s; g unless NULL gets its gradients (added). f unless NULL: the value. */
static double second_run(const model *m, const double *params, const double *code, const double p[3], const double u[3],
                         second_gradients *g, double *f)
{
    static second_layer layers[MODEL_LAYERS];
    const model_desc *d = &m->desc;
    int axis[64], cosine[64], points, size = 0, at, last = m->layers - 1, c = m->sdf_channel;
    double frequency[64], input[MODEL_WIDTH], input_t[MODEL_WIDTH], d_in[MODEL_WIDTH] = {0}, d_in_t[MODEL_WIDTH] = {0};
    double a[MODEL_WIDTH], t[MODEL_WIDTH], epsilon = d->norm_epsilon > 0.0 ? d->norm_epsilon : 1e-5, s = 0.0;
    points = second_encoding(m, axis, frequency, cosine);
    at = d->point_first ? 0 : d->code_size;
    size = points + d->code_size;
    for (int j = 0; j < d->code_size; j++) {
        input[(d->point_first ? points : 0) + j] = code[j];
        input_t[(d->point_first ? points : 0) + j] = 0.0;
    }
    for (int i = 0; i < points; i++) {
        double w = frequency[i], q = p[axis[i]], v = u[axis[i]];
        input[at + i] = w > 0.0 ? cosine[i] ? cos(w * q) : sin(w * q) : q;
        input_t[at + i] = w > 0.0 ? cosine[i] ? -w * sin(w * q) * v : w * cos(w * q) * v : v;
    }
    for (int l = 0; l <= last; l++) {
        second_layer *y = &layers[l];
        int skip = l > 0 && model_sees_input(m, l), out = m->out[l], before = l == 0 || (skip && d->skip_input_first);
        double scale = skip && d->skip_scale > 0.0 ? d->skip_scale : 1.0;
        y->n = 0;
        for (int k = 0; k < size && before; k++, y->n++)
            y->x[y->n] = scale * input[k], y->xt[y->n] = scale * input_t[k];
        for (int k = 0; l > 0 && k < m->out[l - 1]; k++, y->n++) y->x[y->n] = scale * a[k], y->xt[y->n] = scale * t[k];
        for (int k = 0; k < size && skip && !before; k++, y->n++)
            y->x[y->n] = scale * input[k], y->xt[y->n] = scale * input_t[k];
        const double *w = params + m->offset[l], *bias = w + out * y->n, *gamma = bias + out;
        double mean = 0.0, mean_t = 0.0, variance = 0.0;
        for (int o = 0; o < out; o++) {
            a[o] = bias[o];
            t[o] = 0.0;
            for (int k = 0; k < y->n; k++) a[o] += w[o * y->n + k] * y->x[k], t[o] += w[o * y->n + k] * y->xt[k];
            mean += a[o] / out;
            mean_t += t[o] / out;
        }
        if (model_is_normed(m, l)) {
            for (int o = 0; o < out; o++) variance += (a[o] - mean) * (a[o] - mean) / out;
            y->sigma = sqrt(variance + epsilon);
            y->along = 0.0;
            for (int o = 0; o < out; o++) {
                y->hat[o] = (a[o] - mean) / y->sigma;
                y->along += y->hat[o] * t[o] / out;
            }
            for (int o = 0; o < out; o++) {
                y->hat_t[o] = (t[o] - mean_t - y->hat[o] * y->along) / y->sigma;
                a[o] = gamma[o] * y->hat[o] + gamma[out + o];
                t[o] = gamma[o] * y->hat_t[o];
            }
        }
        for (int o = 0; o < out; o++) {
            double v, slope, bend;
            if (l < last) second_activation(m, l, a[o], &v, &slope, &bend);
            else second_output(m, a[o], &v, &slope, &bend);
            y->slope[o] = slope;
            y->bend[o] = bend * t[o];
            a[o] = v;
            t[o] *= slope;
        }
    }
    s = t[c];
    if (f) *f = a[c] - d->level;
    if (!g) return s;
    for (int o = 0; o < m->out[last]; o++) {
        layers[last].d[o] = o == c ? layers[last].bend[o] : 0.0;
        layers[last].dt[o] = o == c ? layers[last].slope[o] : 0.0;
    }
    for (int l = last; l >= 0; l--) {
        second_layer *y = &layers[l];
        int skip = l > 0 && model_sees_input(m, l), out = m->out[l], first = 0;
        const double *w = params + m->offset[l];
        double scale = skip && d->skip_scale > 0.0 ? d->skip_scale : 1.0;
        for (int o = 0; o < out; o++) {
            g->params[m->offset[l] + (size_t)(out * y->n + o)] += y->d[o];
            for (int k = 0; k < y->n; k++)
                g->params[m->offset[l] + (size_t)(o * y->n + k)] += y->d[o] * y->x[k] + y->dt[o] * y->xt[k];
        }
        int input_at = l == 0 ? 0 : skip ? d->skip_input_first ? 0 : m->out[l - 1] : -1;
        if (l > 0 && input_at == 0) first = size;
        for (int k = 0; k < y->n; k++) {
            double back = 0.0, back_t = 0.0;
            for (int o = 0; o < out; o++) back += w[o * y->n + k] * y->d[o], back_t += w[o * y->n + k] * y->dt[o];
            back *= scale, back_t *= scale;
            if (input_at >= 0 && k >= input_at && k < input_at + size) {
                d_in[k - input_at] += back, d_in_t[k - input_at] += back_t;
                continue;
            }
            second_layer *z = &layers[l - 1];
            int o = k - first;
            z->d[o] = z->slope[o] * back + z->bend[o] * back_t;
            z->dt[o] = z->slope[o] * back_t;
        }
        if (l == 0 || !model_is_normed(m, l - 1)) continue;
        second_layer *z = &layers[l - 1];
        int units = m->out[l - 1];
        size_t gamma = m->offset[l - 1] + (size_t)(units * (m->in[l - 1] + 1));
        double mean = 0.0, mean_t = 0.0, on_hat = 0.0, on_hat_t = 0.0, cross = 0.0;
        for (int o = 0; o < units; o++) {
            g->params[gamma + (size_t)o] += z->d[o] * z->hat[o] + z->dt[o] * z->hat_t[o];
            g->params[gamma + (size_t)(units + o)] += z->d[o];
            z->d[o] *= params[gamma + (size_t)o], z->dt[o] *= params[gamma + (size_t)o];
            mean += z->d[o] / units, mean_t += z->dt[o] / units;
            on_hat += z->d[o] * z->hat[o] / units, on_hat_t += z->dt[o] * z->hat[o] / units;
            cross += z->dt[o] * z->hat_t[o] / units;
        }
        for (int o = 0; o < units; o++) {
            double back_t = (z->dt[o] - mean_t - z->hat[o] * on_hat_t) / z->sigma;
            z->d[o] = (z->d[o] - mean - z->hat[o] * on_hat -
                       (z->hat[o] * cross + z->hat_t[o] * on_hat_t + back_t * z->along)) / z->sigma;
            z->dt[o] = back_t;
        }
    }
    for (int j = 0; j < d->code_size; j++) g->code[j] += d_in[(d->point_first ? points : 0) + j];
    for (int i = 0; i < points; i++) {
        double w = frequency[i], x = d_in[at + i], xt = d_in_t[at + i], q = p[axis[i]], v = u[axis[i]];
        if (!(w > 0.0)) g->point[axis[i]] += x;
        else if (cosine[i]) g->point[axis[i]] += -w * sin(w * q) * x - w * w * cos(w * q) * v * xt;
        else g->point[axis[i]] += w * cos(w * q) * x - w * w * sin(w * q) * v * xt;
    }
    return s;
}

/* ---- the library against it -------------------------------------------------------------------------------------- */

enum { POINTS = 61 };

typedef struct second_case {
    model m;
    double code[MODEL_CODE];
    float codef[MODEL_CODE];
    dist_context *ctx;
    dist_net *net;
    dist_shape *shape;
    dist_field field;
    float points[3 * POINTS], directions[3 * POINTS];
    double p[3 * POINTS], u[3 * POINTS];
    int n; /* points away from kinks */
} second_case;

static void case_open(second_case *k, const model_desc *desc, unsigned seed)
{
    test_random random = test_random_seed(seed);
    memset(k, 0, sizeof *k);
    k->m = model_make(desc, seed);
    for (int j = 0; j < desc->code_size; j++) {
        k->code[j] = model_round(MODEL_F32, test_random_double(&random, -0.5, 0.5));
        k->codef[j] = (float)k->code[j];
    }
    k->ctx = test_context();
    k->net = model_load(k->ctx, &k->m);
    k->shape = dist_shape_create(k->ctx, k->net, k->codef);
    MODEL_CHECK(k->shape != NULL, desc->name, dist_context_message(k->ctx), 0, dist_context_status(k->ctx));
    k->field = dist_shape_field(k->shape);
    for (int tries = 0; k->n < POINTS && tries < 40 * POINTS; tries++) {
        double closest;
        for (int i = 0; i < 3; i++) {
            k->points[3 * k->n + i] = test_random_float(&random, -1.0f, 1.0f);
            k->directions[3 * k->n + i] = test_random_float(&random, -2.0f, 2.0f);
            k->p[3 * k->n + i] = (double)k->points[3 * k->n + i];
            k->u[3 * k->n + i] = (double)k->directions[3 * k->n + i];
        }
        model_channels(&k->m, k->m.params, k->code, k->p + 3 * k->n, NULL, NULL, &closest);
        k->n += closest > 1e-4;
    }
    MODEL_CHECK(k->n == POINTS, desc->name, "points away from kinks", POINTS, k->n);
}

static void case_close(second_case *k)
{
    dist_shape_destroy(k->shape);
    dist_net_destroy(k->net);
    dist_context_destroy(k->ctx);
    model_free(&k->m);
}

/* Largest difference, measured by the largest number expected. */
static double apart(size_t n, const float *got, const double *expected)
{
    double worst = 0.0, size = 1e-9;
    for (size_t i = 0; i < n; i++) {
        worst = fmax(worst, fabs((double)got[i] - expected[i]));
        size = fmax(size, fabs(expected[i]));
    }
    return worst / size;
}

static int has_distance(const model_desc *d) { return !d->channels || strstr(d->channels, "sdf"); }

static second_gradients gradients_take(const model *m)
{
    second_gradients g;
    memset(&g, 0, sizeof g);
    g.params = (double *)calloc(m->count, sizeof(double));
    if (!g.params) exit(1);
    return g;
}

TEST(second_derivatives_in_double_match_central_differences)
{
    for (int i = 0; i < MODEL_CASES; i++) {
        const model_desc *desc = &model_cases[i];
        second_case k;
        if (!has_distance(desc)) continue;
        case_open(&k, desc, 200u + (unsigned)i);
        test_random random = test_random_seed(5);
        double worst = 0.0, size = 1e-9, first = 0.0, h = desc->activation == DIST_ACTIVATION_SINE ? 2e-6 : 1e-5;
        second_gradients g = gradients_take(&k.m);
        for (int j = 0; j < (test_quick() ? 3 : 8); j++) {
            double *p = k.p + 3 * j, *u = k.u + 3 * j, gradient[3], f, s;
            memset(g.point, 0, sizeof g.point);
            memset(g.code, 0, sizeof g.code);
            memset(g.params, 0, k.m.count * sizeof(double));
            s = second_run(&k.m, k.m.params, k.code, p, u, &g, &f);
            model_gradient(&k.m, k.m.params, k.code, p, gradient);
            first =
                fmax(first, fabs(s - gradient[0] * u[0] - gradient[1] * u[1] - gradient[2] * u[2]) / (1.0 + fabs(s)));
            first = fmax(first, fabs(f - model_eval(&k.m, k.m.params, k.code, p)));
            int numbers = 3 + desc->code_size + 24;
            for (int a = 0; a < numbers; a++) {
                size_t weight = (size_t)test_random_int(&random, 0, (int)k.m.count - 1);
                double *x = a < 3 ? p + a : a < 3 + desc->code_size ? k.code + a - 3 : k.m.params + weight, old = *x;
                double got = a < 3 ? g.point[a] : a < 3 + desc->code_size ? g.code[a - 3] : g.params[weight];
                double steps[4] = {1.0, -1.0, 2.0, -2.0}, value[4];
                for (int b = 0; b < 4; b++) {
                    *x = old + steps[b] * h;
                    value[b] = second_run(&k.m, k.m.params, k.code, p, u, NULL, NULL);
                }
                *x = old;
                double expected = (8.0 * (value[0] - value[1]) - (value[2] - value[3])) / (12.0 * h);
                worst = fmax(worst, fabs(got - expected));
                size = fmax(size, fabs(expected));
            }
        }
        MODEL_CHECK(first <= 1e-6, desc->name, "s = u . grad f", 0, first);
        MODEL_CHECK(worst <= 1e-6 * size, desc->name, "gradients of s in double", 0, worst / size);
        if (test_state.verbose) printf("    %s: %.1e\n", desc->name, worst / size);
        free(g.params);
        case_close(&k);
    }
}

TEST(second_derivatives_of_every_form_of_net_match_the_double)
{
    for (int i = 0; i < MODEL_CASES; i++) {
        const model_desc *desc = &model_cases[i];
        second_case k;
        if (!has_distance(desc)) continue;
        case_open(&k, desc, 200u + (unsigned)i);
        second_gradients g = gradients_take(&k.m);
        double d_p[3 * POINTS], code[MODEL_CODE] = {0};
        float pulls[3 * POINTS] = {0}, again[3 * POINTS] = {0}, d_codef[MODEL_CODE], *weights;
        double d_code[MODEL_CODE] = {0};
        weights = (float *)calloc(k.m.count, sizeof(float));
        if (!weights) exit(1);
        for (int j = 0; j < POINTS; j++) {
            memset(g.point, 0, sizeof g.point);
            second_run(&k.m, k.m.params, k.code, k.p + 3 * j, k.u + 3 * j, &g, NULL);
            memcpy(d_p + 3 * j, g.point, sizeof g.point);
        }
        k.field.second_fn(k.field.user, 0, POINTS, k.points, k.directions, pulls, desc->code_size ? d_code : NULL);
        for (int j = 0; j < desc->code_size; j++) d_codef[j] = (float)d_code[j];
        double by_point = apart(3 * POINTS, pulls, d_p), by_code = apart((size_t)desc->code_size, d_codef, g.code);
        CHECK_STATUS(DIST_OK,
                     k.field.second_weights_fn(k.field.user, k.ctx, POINTS, k.points, k.directions, again,
                                               desc->code_size ? code : NULL, weights),
                     k.ctx);
        double by_weights = apart(k.m.count, weights, g.params);
        if (test_state.verbose)
            printf("    %s: point %.1e, code %.1e, weights %.1e\n", desc->name, by_point, by_code, by_weights);
        double most = 1e-5;
        MODEL_CHECK(by_point <= most, desc->name, "H u", 0, by_point);
        MODEL_CHECK(by_code <= most, desc->name, "gradient for the code", 0, by_code);
        MODEL_CHECK(by_weights <= most, desc->name, "gradient for the weights", 0, by_weights);
        CHECK_NEAR_ARRAY(3 * POINTS, pulls, again, 0);
        for (int j = 0; j < desc->code_size; j++)
            MODEL_CHECK(fabs(code[j] - d_code[j]) <= 1e-5 * (1.0 + fabs(code[j])), desc->name, "code beside weights",
                        d_code[j], code[j]);
        free(weights);
        free(g.params);
        case_close(&k);
    }
}

static void plain_sgemm(void *user, int transpose_a, int transpose_b, int m, int n, int k, float alpha, const float *a,
                        int lda, const float *b, int ldb, float beta, float *c, int ldc)
{
    ++*(int *)user;
    for (int i = 0; i < m; i++)
        for (int j = 0; j < n; j++) {
            float sum = 0.0f;
            for (int l = 0; l < k; l++)
                sum +=
                    (transpose_a ? a[l * lda + i] : a[i * lda + l]) * (transpose_b ? b[j * ldb + l] : b[l * ldb + j]);
            c[i * ldc + j] = alpha * sum + (beta == 0.0f ? 0.0f : beta * c[i * ldc + j]);
        }
}

TEST(second_derivatives_by_the_users_blas_are_the_same)
{
    const int cases[3] = {5, 15, 24}; /* sine, softplus with a skip, LayerNorm and ReLU */
    for (int i = 0; i < 3; i++) {
        second_case k;
        int calls = 0;
        float plain[3 * POINTS] = {0}, by_blas[3 * POINTS] = {0};
        case_open(&k, &model_cases[cases[i]], 400u + (unsigned)i);
        dist_context_desc desc = test_context_desc();
        desc.blas.user = &calls;
        desc.blas.sgemm_fn = plain_sgemm;
        desc.blas_width = 1;
        dist_context *ctx = dist_context_create(&desc);
        dist_shape *shape = dist_shape_create(ctx, k.net, k.codef);
        dist_field field = dist_shape_field(shape);
        k.field.second_fn(k.field.user, 0, POINTS, k.points, k.directions, plain, NULL);
        calls = 0;
        field.second_fn(field.user, 0, POINTS, k.points, k.directions, by_blas, NULL);
        CHECK(calls > 0);
        double largest = 0.0, worst = 0.0;
        for (int j = 0; j < 3 * POINTS; j++) {
            largest = fmax(largest, fabs((double)plain[j]));
            worst = fmax(worst, fabs((double)plain[j] - (double)by_blas[j]));
        }
        CHECK(largest > 0.0);
        MODEL_CHECK(worst <= 1e-5 * largest, k.m.desc.name, "by BLAS", 0, worst / largest);
        dist_shape_destroy(shape);
        dist_context_destroy(ctx);
        case_close(&k);
    }
}

/* The double evaluates the net of the data folder, agrees there with its reference in f and grad f, and then says what
   the second derivatives are. */
TEST(second_derivatives_of_two_spheres_sine_match_the_double)
{
    enum { ROWS = 256 };
    static float points[3 * ROWS], directions[3 * ROWS], pulls[3 * ROWS];
    static double expected[3 * ROWS];
    model m;
    size_t size;
    double *reference = (double *)test_file_read(test_data_path("nets/two_spheres_sine.ref.f64"), &size), worst = 0.0;
    if (!reference) SKIP("the real decoders are not here");
    dist_context *ctx = test_context();
    dist_net *net = dist_net_load_file(ctx, test_data_path("nets/two_spheres_sine.safetensors"));
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    CHECK_EQUAL(ROWS * 7, (int)(size / sizeof(double)));
    memset(&m, 0, sizeof m);
    m.desc.activation = DIST_ACTIVATION_SINE;
    m.desc.first_scale = m.desc.scale = 30.0;
    m.desc.output = MODEL_NONE;
    m.layers = 4;
    for (int l = 0; l < m.layers; l++) {
        m.in[l] = l ? 64 : 3;
        m.out[l] = l < 3 ? 64 : 1;
        m.offset[l] = m.count;
        m.count += (size_t)((m.in[l] + 1) * m.out[l]);
    }
    m.point_size = 3;
    CHECK_EQUAL((int)m.count, (int)dist_net_weight_count(net));
    m.params = (double *)calloc(m.count, sizeof(double));
    if (!m.params) exit(1);
    for (size_t i = 0; i < m.count; i++) m.params[i] = (double)dist_net_weights(net)[i];
    second_gradients g = gradients_take(&m);
    test_random random = test_random_seed(8);
    for (int i = 0; i < ROWS; i++) {
        const double *r = reference + 7 * i;
        double u[3], f;
        for (int k = 0; k < 3; k++) {
            double along[3] = {k == 0, k == 1, k == 2};
            worst = fmax(worst, fabs(second_run(&m, m.params, NULL, r, along, NULL, &f) - r[4 + k]));
            points[3 * i + k] = (float)r[k];
            directions[3 * i + k] = test_random_float(&random, -1.0f, 1.0f);
            u[k] = (double)directions[3 * i + k];
        }
        worst = fmax(worst, fabs(f - r[3]));
        memset(g.point, 0, sizeof g.point);
        double p[3] = {(double)points[3 * i], (double)points[3 * i + 1], (double)points[3 * i + 2]};
        second_run(&m, m.params, NULL, p, u, &g, NULL);
        memcpy(expected + 3 * i, g.point, sizeof g.point);
    }
    CHECK(worst <= 1e-9);
    dist_field field = dist_shape_field(shape);
    field.second_fn(field.user, 0, ROWS, points, directions, pulls, NULL);
    double error = apart(3 * ROWS, pulls, expected);
    if (test_state.verbose) printf("    value and gradient %.1e, H u %.1e\n", worst, error);
    CHECK(error <= 1e-4);
    free(g.params);
    free(m.params);
    free(reference);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* ---- the eikonal term -------------------------------------------------------------------------------------------- */

/* L = weight * mean (|grad f| - 1)^2 in double, with its gradients. */
static double eikonal_run(second_case *k, double weight, second_gradients *g)
{
    double sum = 0.0;
    for (int i = 0; i < POINTS; i++) {
        double gradient[3], u[3], length = 0.0;
        for (int a = 0; a < 3; a++) {
            double along[3] = {a == 0, a == 1, a == 2};
            gradient[a] = second_run(&k->m, k->m.params, k->code, k->p + 3 * i, along, NULL, NULL);
            length += gradient[a] * gradient[a];
        }
        length = sqrt(length);
        sum += (length - 1.0) * (length - 1.0);
        for (int a = 0; a < 3; a++) u[a] = 2.0 * weight / POINTS * (1.0 - 1.0 / length) * gradient[a];
        if (g) second_run(&k->m, k->m.params, k->code, k->p + 3 * i, u, g, NULL);
    }
    return weight * sum / POINTS;
}

TEST(eikonal_term_and_its_gradients_match_the_double)
{
    for (int i = 0; i < MODEL_CASES; i++) {
        const model_desc *desc = &model_cases[i];
        second_case k;
        if (!has_distance(desc)) continue;
        case_open(&k, desc, 300u + (unsigned)i);
        second_gradients g = gradients_take(&k.m);
        float code[MODEL_CODE] = {0}, alone[MODEL_CODE] = {0}, loss = -1.0f, only = -1.0f;
        float *weights = (float *)calloc(k.m.count, sizeof(float));
        dist_gradients grads;
        if (!weights) exit(1);
        memset(&grads, 0, sizeof grads);
        double expected = eikonal_run(&k, 0.7, &g);
        grads.code = desc->code_size ? code : NULL;
        grads.weights = weights;
        CHECK_STATUS(DIST_OK, dist_field_eikonal(k.ctx, &k.field, POINTS, k.points, 0.7f, &loss, &grads), k.ctx);
        CHECK_STATUS(DIST_OK, dist_field_eikonal(k.ctx, &k.field, POINTS, k.points, 0.7f, &only, NULL), k.ctx);
        MODEL_CHECK(fabs((double)loss - expected) <= 1e-5 * (1e-3 + expected), desc->name, "loss", expected, loss);
        CHECK_NEAR((double)loss, (double)only, 0);
        double by_code = apart((size_t)desc->code_size, code, g.code), by_weights = apart(k.m.count, weights, g.params);
        MODEL_CHECK(by_code <= 2e-5, desc->name, "gradient for the code", 0, by_code);
        MODEL_CHECK(by_weights <= 2e-5, desc->name, "gradient for the weights", 0, by_weights);
        if (test_state.verbose) printf("    %s: code %.1e, weights %.1e\n", desc->name, by_code, by_weights);
        grads.code = desc->code_size ? alone : NULL;
        grads.weights = NULL;
        CHECK_STATUS(DIST_OK, dist_field_eikonal(k.ctx, &k.field, POINTS, k.points, 0.7f, NULL, &grads), k.ctx);
        double without = apart((size_t)desc->code_size, alone, g.code);
        MODEL_CHECK(without <= 2e-5, desc->name, "gradient for the code alone", 0, without);
        free(weights);
        free(g.params);
        case_close(&k);
    }
}

/* f = a (|p| - r), code a, r: a field of one's own, with values and adjoint only. */
static void cone_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const float *c = (const float *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        float length = sqrtf(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
        sdf[i] = c[0] * (length - c[1]);
        for (size_t k = 0; gradient && k < 3; k++) gradient[3 * i + k] = c[0] * p[k] / length;
    }
}

static void cone_adjoint(void *user, int worker, size_t n, const float *points, const float *d_sdf, double *d_code)
{
    const float *c = (const float *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++) {
        const float *p = points + 3 * i;
        d_code[0] += (double)d_sdf[i] * ((double)sqrtf(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) - (double)c[1]);
        d_code[1] -= (double)d_sdf[i] * (double)c[0];
    }
}

static dist_field cone_field(float numbers[2])
{
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = numbers;
    field.eval_fn = cone_eval;
    field.adjoint_fn = cone_adjoint;
    field.radius = 1.0f;
    field.code_size = 2;
    return field;
}

/* However flat f is, the term pulls it up: of f = a (w . x), |w| = 1, dL/da = 2 (|a| - 1) sign(a), and 0 at a = 0. */
TEST(eikonal_term_pulls_at_what_is_hardly_sloped)
{
    const float slopes[7] = {0.5f, 1e-3f, 1e-11f, -1e-13f, 1e-20f, 1e-37f, 0};
    dist_context *ctx = test_context();
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 1;
    desc.width = 1;
    desc.activation = DIST_ACTIVATION_NONE;
    desc.output_linear = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    REQUIRE(net && dist_net_weight_count(net) == 6);
    for (int k = 0; k < 7; k++) {
        float weights[6] = {0.6f, 0, -0.8f, 0.1f, 0, 0}, d_weights[6] = {0, 0, 0, 0, 0, 0}, loss = 0;
        const float point[3] = {0.2f, 0.1f, -0.3f};
        double a = (double)slopes[k];
        weights[4] = slopes[k];
        CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, weights), ctx);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        dist_field field = dist_shape_field(shape);
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        grads.weights = d_weights;
        CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, 1, point, 1, &loss, &grads), ctx);
        CHECK_NEAR((fabs(a) - 1) * (fabs(a) - 1), loss, 1e-6);
        CHECK_NEAR(2 * (fabs(a) - 1) * (a > 0 ? 1 : a < 0 ? -1 : 0), d_weights[4], 1e-5);
        dist_shape_destroy(shape);
    }
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(eikonal_term_of_a_field_without_second_derivatives_is_by_differences)
{
    enum { MANY = 7000 }; /* more than one chunk */
    static float points[3 * MANY];
    float numbers[2] = {1.6f, 0.5f}, loss = 0.0f, code[2] = {1.0f, 2.0f};
    dist_field field = cone_field(numbers);
    dist_context *ctx = test_context();
    dist_gradients grads;
    test_random random = test_random_seed(4);
    memset(&grads, 0, sizeof grads);
    grads.code = code;
    test_random_fill(&random, 3 * MANY, points, 0.2f, 0.9f);
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, MANY, points, 0.5f, &loss, &grads), ctx);
    CHECK_NEAR(0.5 * 0.36, (double)loss, 1e-6);
    CHECK_NEAR(1.0 + 0.5 * 2.0 * 0.6, (double)code[0], 2e-4); /* added to */
    CHECK_NEAR(2.0, (double)code[1], 2e-4);
    for (int power = -30; power <= 30; power += 5) { /* linear in the weight, whatever that is */
        float weight = (float)pow(10.0, power);
        code[0] = 0.0f;
        CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, MANY, points, weight, NULL, &grads), ctx);
        CHECK_NEAR(1.2, (double)code[0] / (double)weight, 4e-4);
    }
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, MANY, points, 3e38f, &loss, NULL), ctx);
    CHECK_NEAR(3e38 * 0.36, (double)loss, 1e33);
    numbers[0] = 1e25f; /* steeper than a float's square: it adds what it adds, or the largest float */
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, MANY, points, 1e-30f, &loss, NULL), ctx);
    CHECK_NEAR(1e20, (double)loss, 1e14);
    code[0] = 0.0f;
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, MANY, points, 1.0f, &loss, &grads), ctx);
    CHECK(loss > 3e38f);
    CHECK(code[0] > 1e24f && code[0] < 3e25f);
    dist_context_destroy(ctx);
}

/* Trains f = 0 on a sphere of radius 0.5 and nothing else but |grad f| = 1: f becomes the distance. */
static void train_a_ball(int activation, float scale, double most_error)
{
    enum { ON = 96, AROUND = 192, STEPS = 150 };
    dist_context *ctx = test_context();
    dist_net_desc desc;
    dist_adam adam;
    dist_gradients grads;
    float points[3 * AROUND], surface[3 * ON], sdf[AROUND], gradient[3 * AROUND], loss = 0.0f;
    double before = 0.0, after = 0.0, error = 0.0;
    test_random random = test_random_seed(6);
    memset(&desc, 0, sizeof desc);
    desc.layers = 2;
    desc.width = 24;
    desc.activation = activation;
    desc.scale = scale;
    desc.output_linear = 1;
    desc.seed = 2;
    dist_net *net = dist_net_create(ctx, &desc);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    size_t count = dist_net_weight_count(net);
    float *weights = (float *)malloc(count * sizeof(float)), *d_weights = (float *)malloc(count * sizeof(float));
    memset(&adam, 0, sizeof adam);
    memset(&grads, 0, sizeof grads);
    adam.moments = (float *)calloc(2 * count, sizeof(float));
    if (!weights || !d_weights || !adam.moments) exit(1);
    memcpy(weights, dist_net_weights(net), count * sizeof(float));
    grads.weights = d_weights;
    for (int step = 0; step <= STEPS; step++) {
        dist_field field = dist_shape_field(shape);
        test_random_fill(&random, 3 * AROUND, points, -0.8f, 0.8f);
        for (int i = 0; i < ON; i++) {
            test_random_direction(&random, surface + 3 * i);
            for (int k = 0; k < 3; k++) surface[3 * i + k] *= 0.5f;
        }
        memset(d_weights, 0, count * sizeof(float));
        CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, AROUND, points, 1.0f, &loss, &grads), ctx);
        if (step == 0) before = (double)loss;
        dist_field_eval(ctx, &field, ON, surface, sdf, NULL);
        for (int i = 0; i < ON; i++) sdf[i] *= 20.0f / ON; /* 10 mean f^2 */
        dist_field_backward(ctx, &field, ON, surface, sdf, NULL, NULL, NULL, &grads);
        if (step == STEPS) break;
        adam.rate = step < 2 * STEPS / 3 ? 1e-2f : 3e-3f;
        dist_adam_step(&adam, count, weights, d_weights);
        dist_net_set_weights(ctx, net, weights);
        dist_shape_set_code(shape, NULL);
    }
    after = (double)loss;
    dist_field field = dist_shape_field(shape);
    dist_field_eval(ctx, &field, AROUND, points, sdf, gradient);
    for (int i = 0; i < AROUND; i++) {
        float *g = gradient + 3 * i;
        error += fabs(sqrt((double)(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])) - 1.0) / AROUND;
    }
    if (test_state.verbose) printf("    eikonal term %.3g -> %.3g, ||grad f| - 1| %.3f\n", before, after, error);
    CHECK(after < 0.1 * before);
    CHECK(error < most_error);
    free(adam.moments);
    free(d_weights);
    free(weights);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

TEST(training_with_the_eikonal_term_makes_a_softplus_net_a_distance)
{
    train_a_ball(DIST_ACTIVATION_SOFTPLUS, 10.0f, 0.15);
}

TEST(training_with_the_eikonal_term_makes_a_sine_net_a_distance) { train_a_ball(DIST_ACTIVATION_SINE, 3.0f, 0.15); }

TEST(eikonal_gradients_have_the_same_bits_for_every_number_of_workers)
{
    enum { MANY = 1500 };
    static const int counts[3] = {1, 2, 7};
    static float points[3 * MANY], first[8192], other[8192];
    for (int c = 0; c < 3; c++) {
        test_scheduler scheduler;
        dist_context_desc desc = test_context_desc();
        model m = model_make(&model_cases[MODEL_CASES - 1], 9);
        float code[MODEL_CODE] = {0.1f, -0.2f}, *to = c ? other : first, loss = 0.0f;
        dist_gradients grads;
        test_random random = test_random_seed(10);
        memset(&scheduler, 0, sizeof scheduler);
        scheduler.workers = desc.workers = counts[c];
        desc.scheduler = test_scheduler_hook(&scheduler);
        dist_context *ctx = dist_context_create(&desc);
        dist_net *net = model_load(ctx, &m);
        dist_shape *shape = dist_shape_create(ctx, net, code);
        dist_field field = dist_shape_field(shape);
        CHECK(m.count + 2 * MODEL_CODE + 1 <= 8192);
        memset(to, 0, sizeof first);
        memset(&grads, 0, sizeof grads);
        test_random_fill(&random, 3 * MANY, points, -1.0f, 1.0f);
        grads.weights = to;
        grads.code = to + m.count;
        CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, MANY, points, 1.0f, &loss, &grads), ctx);
        grads.weights = NULL;
        grads.code = to + m.count + MODEL_CODE;
        CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, MANY, points, 1.0f, &loss, &grads), ctx);
        to[m.count + 2 * MODEL_CODE] = loss;
        CHECK(loss > 0.0f);
        if (c) CHECK_BYTES(sizeof first, first, other);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_context_destroy(ctx);
        model_free(&m);
    }
}

/* A net that overflows: f is NaN there, its gradient 0. */
static void blind_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    uint32_t bits = 0x7fc00000u;
    cone_eval(user, worker, n, points, sdf, gradient);
    for (size_t i = 0; i < n; i++) {
        if (points[3 * i] > 0.0f) continue;
        memcpy(&sdf[i], &bits, sizeof bits);
        for (size_t k = 0; gradient && k < 3; k++) gradient[3 * i + k] = 0.0f;
    }
}

TEST(eikonal_of_points_that_are_not_finite_is_left_out_and_nonsense_refused)
{
    float numbers[2] = {2.0f, 0.5f}, code[2] = {0}, three[3] = {0}, loss = 0.0f;
    float points[9] = {0.5f, 0.1f, 0.2f, 0.3f, 0.4f, 0.5f, -0.5f, 0.1f, 0.1f}, good[6];
    uint32_t bits = 0x7fc00000u;
    memcpy(&points[3], &bits, sizeof bits);
    memcpy(good, points, 3 * sizeof(float));
    memcpy(good + 3, points + 6, 3 * sizeof(float));
    dist_field field = cone_field(numbers);
    dist_context *ctx = test_context();
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, 3, points, 3.0f, &loss, NULL), ctx);
    CHECK_NEAR(2.0, (double)loss, 1e-5);
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, 0, NULL, 3.0f, &loss, NULL), ctx);
    CHECK_NEAR(0.0, (double)loss, 0);
    field.eval_fn = blind_eval;
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, 2, good, 3.0f, &loss, NULL), ctx);
    CHECK_NEAR(1.5, (double)loss, 1e-5); /* of the first point alone */
    field.eval_fn = cone_eval;
    loss = 7.0f; /* what errors leave alone */
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_field_eikonal(ctx, &field, 2, NULL, 1.0f, &loss, NULL));
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_field_eikonal(ctx, NULL, 2, good, 1.0f, &loss, NULL));
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_field_eikonal(ctx, &field, 2, good, points[3], &loss, NULL));
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_field_eikonal(NULL, &field, 2, good, 1.0f, &loss, NULL));
    grads.rotation = three;
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_field_eikonal(ctx, &field, 2, good, 1.0f, &loss, &grads));
    grads.rotation = NULL;
    grads.weights = three;
    CHECK_EQUAL(DIST_UNSUPPORTED, dist_field_eikonal(ctx, &field, 2, good, 1.0f, &loss, &grads));
    CHECK_NEAR(7.0, (double)loss, 0);
    grads.weights = NULL;
    grads.code = code;
    dist_context_clear(ctx);
    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, 2, good, 1.0f, &loss, &grads), ctx);
    CHECK_NEAR(2.0, (double)code[0], 1e-3);
    dist_context_destroy(ctx);
}

/* One bad point among others, or one bad seed, takes nothing from what the others say of code and weights. */
TEST(points_that_are_not_finite_take_nothing_from_the_others)
{
    enum { N = 60, BAD = 31 };
    static const model_desc nets[] = {
        {.name = "relu", .code_size = 3},
        {.name = "normed elu", .code_size = 3, .activation = DIST_ACTIVATION_ELU, .normed = 1},
        {.name = "softplus", .code_size = 3, .activation = DIST_ACTIVATION_SOFTPLUS, .scale = 5, .first_scale = 5}};
    static float points[3 * N], seeds[N], d_points[3 * N], weights[2][20000];
    float torus[5] = {0.1f, 0, 0, 0.5f, 0.2f}, code[3] = {0.3f, -0.2f, 0.1f};
    const float bad[3] = {(float)NAN, (float)INFINITY, 0};
    for (int k = 0; k < 4; k++) {
        dist_context *ctx = test_context();
        model m;
        dist_net *net = NULL;
        dist_shape *shape = NULL;
        dist_field field = dist_field_torus(torus);
        if (k < 3) {
            m = model_make(&nets[k], 5);
            net = model_load(ctx, &m);
            shape = dist_shape_create(ctx, net, code);
            field = dist_shape_field(shape);
            REQUIRE(field.weight_count <= 20000);
        }
        for (int with = 0; with < 2 * 3 * 2; with++) { /* weights, too; NaN, infinity, a seed; backward, eikonal */
            float grads_code[2][5] = {{0}}, loss[2] = {0, 0};
            int heavy = with & 1, kind = with / 2 % 3, eikonal = with / 6;
            test_random random = test_random_seed(3);
            if ((heavy && k == 3) || (eikonal && kind == 2)) continue;
            memset(weights, 0, sizeof weights);
            for (int spoiled = 0; spoiled < 2; spoiled++) {
                dist_gradients grads;
                size_t n = spoiled ? N : N - 1; /* the other one goes without */
                random = test_random_seed(3);
                test_random_fill(&random, 3 * N, points, -0.8f, 0.8f);
                test_random_fill(&random, N, seeds, -1, 1);
                if (spoiled && kind < 2) points[3 * BAD + 1] = bad[kind];
                if (spoiled && kind == 2) seeds[BAD] = bad[0];
                for (int i = BAD; !spoiled && i + 1 < N; i++) {
                    memcpy(points + 3 * i, points + 3 * i + 3, 3 * sizeof(float));
                    seeds[i] = seeds[i + 1];
                }
                memset(&grads, 0, sizeof grads);
                memset(d_points, 0, sizeof d_points);
                grads.code = grads_code[spoiled];
                if (heavy) grads.weights = weights[spoiled];
                float mean = (float)n / (float)N; /* of what the eikonal term is a mean over */
                if (eikonal)
                    CHECK_STATUS(DIST_OK, dist_field_eikonal(ctx, &field, n, points, mean, &loss[spoiled], &grads),
                                 ctx);
                else
                    CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &field, n, points, seeds, NULL, NULL, d_points,
                                                              &grads), ctx);
                for (size_t j = 0; j < 3 * n; j++) CHECK(test_finite((double)d_points[j]));
            }
            double largest = 0;
            for (int j = 0; j < field.code_size; j++) largest = fmax(largest, fabs((double)grads_code[0][j]));
            CHECK(eikonal || largest > 1e-3);
            for (int j = 0; j < field.code_size; j++)
                MODEL_CHECK(fabs((double)grads_code[0][j] - (double)grads_code[1][j]) <= 1e-4 * largest + 1e-6,
                            k < 3 ? nets[k].name : "torus", eikonal ? "eikonal" : "backward", with, j);
            CHECK_NEAR(loss[0], loss[1], 1e-4 * (1 + (double)loss[0]));
            for (size_t j = 0; heavy && j < field.weight_count; j++)
                CHECK_NEAR(weights[0][j], weights[1][j], 1e-3 * (1 + fabs((double)weights[0][j])));
        }
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        if (k < 3) model_free(&m);
        dist_context_destroy(ctx);
    }
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(second_derivatives_in_double_match_central_differences);
    RUN(second_derivatives_of_every_form_of_net_match_the_double);
    RUN(second_derivatives_by_the_users_blas_are_the_same);
    RUN(second_derivatives_of_two_spheres_sine_match_the_double);
    RUN(eikonal_term_and_its_gradients_match_the_double);
    RUN(eikonal_term_pulls_at_what_is_hardly_sloped);
    RUN(eikonal_term_of_a_field_without_second_derivatives_is_by_differences);
    RUN(training_with_the_eikonal_term_makes_a_softplus_net_a_distance);
    RUN(training_with_the_eikonal_term_makes_a_sine_net_a_distance);
    RUN(eikonal_gradients_have_the_same_bits_for_every_number_of_workers);
    RUN(eikonal_of_points_that_are_not_finite_is_left_out_and_nonsense_refused);
    RUN(points_that_are_not_finite_take_nothing_from_the_others);
    return test_report();
}
