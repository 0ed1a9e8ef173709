/* SPDX-License-Identifier: MIT-0
   model.h - small decoders for the tests: their numbers in double, their file, and an evaluation written plainly

   A model is described (model_desc), filled with random numbers (model_make) and written as safetensors bytes
   (model_file). model_eval is what the format says, in double and in the order it says it, and shares nothing with the
   library but the order of the weights. Derivatives are central differences of it. */
#ifndef DIST_MODEL_H
#define DIST_MODEL_H

#include "test.h"

enum { MODEL_LAYERS = 8, MODEL_WIDTH = 256, MODEL_CODE = 16 };
enum { MODEL_F32, MODEL_F16, MODEL_BF16 };
enum { MODEL_PLAIN, MODEL_WEIGHT_NORM, MODEL_PARAMETRIZED }; /* how weights are spelled in the file */
enum { MODEL_TANH, MODEL_NONE, MODEL_SIGMOID, MODEL_TANH_TWICE };
enum { MODEL_SIN_COS, MODEL_COS_ALL, MODEL_SIN_ALL };

/* What is 0 is the format's default and then not written into the file, unless told is 1. */
typedef struct model_desc {
    const char *name;
    int hidden, width; /* 0: 3 layers of 12, of slightly different widths */
    int skip;          /* a bit for each layer */
    int code_size, code_count;
    int activation;
    double first_scale, scale;
    int output;
    int point_first, skip_input_first;
    double skip_scale;
    int fourier, levels, no_raw, order;
    double base;
    int normed;
    double norm_epsilon, level, bound, clamp;
    const char *channels;
    int dtype, spelling, module, told;
} model_desc;

typedef struct model {
    model_desc desc;
    int layers, channels, sdf_channel, point_size;
    int in[MODEL_LAYERS], out[MODEL_LAYERS];
    size_t offset[MODEL_LAYERS]; /* of a layer's weight in params; bias, norm weight, norm bias follow */
    size_t count;
    double *params; /* as dist_net_weights has them */
    float *v, *g;   /* weight norm: what the file has instead of weights, v in the places of params */
    double codes[4 * MODEL_CODE];
} model;

static double model_tiny_gain = 1.0; /* last-layer factor of model_make */

TEST_UNUSED static int model_sees_input(const model *m, int l) { return l == 0 || (m->desc.skip >> l & 1); }

TEST_UNUSED static int model_is_normed(const model *m, int l) { return m->desc.normed && l + 1 < m->layers; }

/* The nearest number that the file's type can hold. */
TEST_UNUSED static double model_round(int dtype, double x)
{
    int exponent, digits = dtype == MODEL_F16 ? 11 : dtype == MODEL_BF16 ? 8 : 24;
    double mantissa = frexp(x, &exponent);
    if (exponent < -12) return 0.0;
    return ldexp(floor(ldexp(mantissa, digits) + 0.5), exponent - digits);
}

/* ---- the evaluation ---------------------------------------------------------------------------------------------- */

TEST_UNUSED static int model_encode(const model *m, const double p[3], double *x)
{
    const model_desc *d = &m->desc;
    int n = 0;
    double base = d->base > 0.0 ? d->base : 3.14159265358979323846;
    if (!d->fourier || !d->no_raw)
        for (int i = 0; i < 3; i++) x[n++] = p[i];
    if (!d->fourier) return n;
    if (d->order == MODEL_SIN_COS) {
        for (int k = 0; k < d->levels; k++) {
            for (int i = 0; i < 3; i++) x[n++] = sin(ldexp(base, k) * p[i]);
            for (int i = 0; i < 3; i++) x[n++] = cos(ldexp(base, k) * p[i]);
        }
        return n;
    }
    for (int half = 0; half < 2; half++)
        for (int k = 0; k < d->levels; k++)
            for (int i = 0; i < 3; i++) {
                double a = ldexp(base, k) * p[i];
                x[n++] = (d->order == MODEL_SIN_ALL) == (half == 0) ? sin(a) : cos(a);
            }
    return n;
}

TEST_UNUSED static double model_activate(const model *m, int l, double x)
{
    double scale = l == 0 ? m->desc.first_scale : m->desc.scale;
    switch (m->desc.activation) {
    case DIST_ACTIVATION_RELU: return x > 0.0 ? x : 0.0;
    case DIST_ACTIVATION_ELU: return x > 0.0 ? x : expm1(x);
    case DIST_ACTIVATION_SOFTPLUS: return (scale * x > 30.0 ? x : log1p(exp(scale * x)) / scale);
    case DIST_ACTIVATION_SINE: return sin(scale * x);
    case DIST_ACTIVATION_TANH: return tanh(x);
    default: return x;
    }
}

TEST_UNUSED static double model_output(const model *m, double x)
{
    switch (m->desc.output) {
    case MODEL_TANH: return tanh(x);
    case MODEL_TANH_TWICE: return tanh(tanh(x));
    case MODEL_SIGMOID: return 1.0 / (1.0 + exp(-x));
    default: return x;
    }
}

TEST_UNUSED static void model_layer_norm(const model *m, int units, const double *gamma, const double *beta, double *y)
{
    double mean = 0.0, variance = 0.0;
    for (int u = 0; u < units; u++) mean += y[u] / units;
    for (int u = 0; u < units; u++) variance += (y[u] - mean) * (y[u] - mean) / units;
    double epsilon = m->desc.norm_epsilon > 0.0 ? m->desc.norm_epsilon : 1e-5;
    for (int u = 0; u < units; u++) y[u] = gamma[u] * (y[u] - mean) / sqrt(variance + epsilon) + beta[u];
}

/* All channels at p, the level taken off the distance; returns the distance (channel 0 if there is none).
   features: NULL or what the last layer sees. closest: NULL or how near to its kink a ReLU comes. */
TEST_UNUSED static double model_channels(const model *m, const double *params, const double *code, const double p[3],
                                         double *channels, double *features, double *closest)
{
    double input[MODEL_WIDTH], x[MODEL_WIDTH], row[MODEL_WIDTH], y[MODEL_WIDTH];
    const model_desc *d = &m->desc;
    int size = 0, width = 0;
    if (!d->point_first)
        for (int j = 0; j < d->code_size; j++) input[size++] = code[j];
    size += model_encode(m, p, input + size);
    if (d->point_first)
        for (int j = 0; j < d->code_size; j++) input[size++] = code[j];
    if (closest) *closest = 1e300;
    for (int l = 0; l < m->layers; l++) {
        int n = 0, last = l + 1 == m->layers, skip = l > 0 && model_sees_input(m, l);
        double scale = skip && d->skip_scale > 0.0 ? d->skip_scale : 1.0;
        if (l == 0 || (skip && d->skip_input_first))
            for (int k = 0; k < size; k++) row[n++] = scale * input[k];
        for (int k = 0; k < width; k++) row[n++] = scale * x[k];
        if (skip && !d->skip_input_first)
            for (int k = 0; k < size; k++) row[n++] = scale * input[k];
        const double *w = params + m->offset[l], *bias = w + (size_t)m->out[l] * (size_t)n;
        for (int o = 0; o < m->out[l]; o++) {
            y[o] = bias[o];
            for (int k = 0; k < n; k++) y[o] += w[o * n + k] * row[k];
        }
        if (last && features) memcpy(features, row, (size_t)n * sizeof(double));
        if (!last && d->normed) model_layer_norm(m, m->out[l], bias + m->out[l], bias + 2 * m->out[l], y);
        for (int o = 0; o < m->out[l]; o++) {
            if (!last && closest && d->activation == DIST_ACTIVATION_RELU && fabs(y[o]) < *closest)
                *closest = fabs(y[o]);
            x[o] = last ? model_output(m, y[o]) : model_activate(m, l, y[o]);
        }
        width = m->out[l];
    }
    if (m->sdf_channel >= 0) x[m->sdf_channel] -= d->level;
    if (channels) memcpy(channels, x, (size_t)m->channels * sizeof(double));
    return x[m->sdf_channel >= 0 ? m->sdf_channel : 0];
}

TEST_UNUSED static double model_eval(const model *m, const double *params, const double *code, const double p[3])
{
    return model_channels(m, params, code, p, NULL, NULL, NULL);
}

/* f of a sphere, torus or box by its numbers, as dist_field_sphere and others have them, or of a net by its code. */
enum { SPHERE, TORUS, BOX, NET, KINDS };
TEST_UNUSED static double model_field(int kind, const model *m, const double *c, const double p[3])
{
    if (kind == NET) return model_eval(m, m->params, c, p);
    double q[3] = {p[0] - c[0], p[1] - c[1], p[2] - c[2]};
    if (kind == SPHERE) return sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2]) - c[3];
    if (kind == TORUS) {
        double h = sqrt(q[0] * q[0] + q[2] * q[2]) - c[3];
        return sqrt(h * h + q[1] * q[1]) - c[4];
    }
    double outside = 0.0, most = -1e300;
    for (int i = 0; i < 3; i++) {
        double a = fabs(q[i]) - c[3 + i];
        outside += a > 0.0 ? a * a : 0.0;
        most = fmax(most, a);
    }
    return sqrt(outside) + fmin(most, 0.0);
}

/* df/dp by central differences. */
TEST_UNUSED static void model_gradient(const model *m, const double *params, const double *code, const double p[3],
                                       double gradient[3])
{
    const double h = 1e-6;
    for (int i = 0; i < 3; i++) {
        double q[3] = {p[0], p[1], p[2]};
        q[i] = p[i] + h;
        gradient[i] = model_eval(m, params, code, q);
        q[i] = p[i] - h;
        gradient[i] = (gradient[i] - model_eval(m, params, code, q)) / (2.0 * h);
    }
}

/* ---- making one -------------------------------------------------------------------------------------------------- */

TEST_UNUSED static void model_free(model *m)
{
    free(m->params);
    free(m->v);
    free(m->g);
    memset(m, 0, sizeof *m);
}

TEST_UNUSED static void model_arrange(model *m)
{
    const model_desc *d = &m->desc;
    int hidden = d->hidden ? d->hidden : 3, width = d->width ? d->width : 12;
    const char *names = d->channels ? d->channels : "sdf";
    m->sdf_channel = -1;
    m->channels = 0;
    while (*names) {
        if (strncmp(names, "sdf", 3) == 0) m->sdf_channel = m->channels;
        names += strcspn(names, ",");
        names += *names == ',';
        m->channels++;
    }
    m->layers = hidden + 1;
    m->point_size = d->fourier ? (d->no_raw ? 0 : 3) + 6 * d->levels : 3;
    m->count = 0;
    for (int l = 0; l < m->layers; l++) {
        m->out[l] = l + 1 == m->layers ? m->channels : width + l % 3 * 3;
        m->in[l] = (l ? m->out[l - 1] : 0) + (model_sees_input(m, l) ? m->point_size + d->code_size : 0);
        m->offset[l] = m->count;
        m->count += (size_t)(m->in[l] + 1 + (model_is_normed(m, l) ? 2 : 0)) * (size_t)m->out[l];
    }
}

TEST_UNUSED static model model_make(const model_desc *desc, unsigned seed)
{
    model m;
    memset(&m, 0, sizeof m);
    m.desc = *desc;
    test_random random = test_random_seed(seed);
    model_desc *d = &m.desc;
    int sine = d->activation == DIST_ACTIVATION_SINE;
    if (d->first_scale <= 0.0) d->first_scale = sine ? 30.0 : 1.0;
    if (d->scale <= 0.0) d->scale = d->first_scale;
    model_arrange(&m);
    m.params = (double *)calloc(m.count, sizeof(double));
    m.v = (float *)calloc(m.count, sizeof(float));
    m.g = (float *)calloc(m.count, sizeof(float));
    if (!m.params || !m.v || !m.g) exit(1);
    for (int l = 0; l < m.layers; l++) {
        size_t n = (size_t)m.in[l], out = (size_t)m.out[l];
        double *w = m.params + m.offset[l], *bias = w + n * out;
        double gain = sine ? (l ? 1.4 / sqrt((double)n) / d->scale : 0.5 / (double)n) : 1.2 / sqrt((double)n);
        if (l + 1 == m.layers) gain *= model_tiny_gain;
        for (size_t i = 0; i < out * n; i++) w[i] = model_round(d->dtype, gain * test_random_normal(&random));
        for (size_t o = 0; d->spelling && o < out; o++) {
            double sum = 0.0;
            m.g[o + m.offset[l]] = (float)(0.5 + test_random_double(&random, 0.0, 1.0));
            for (size_t k = 0; k < n; k++) {
                m.v[m.offset[l] + o * n + k] = (float)w[o * n + k];
                sum += w[o * n + k] * w[o * n + k];
            }
            for (size_t k = 0; k < n; k++) w[o * n + k] *= (double)m.g[o + m.offset[l]] / sqrt(sum);
        }
        for (size_t o = 0; o < out; o++) bias[o] = model_round(d->dtype, 0.2 * test_random_normal(&random));
        for (size_t o = 0; model_is_normed(&m, l) && o < out; o++) {
            bias[out + o] = model_round(d->dtype, 1.0 + 0.2 * test_random_normal(&random));
            bias[2 * out + o] = model_round(d->dtype, 0.2 * test_random_normal(&random));
        }
    }
    for (int i = 0; i < d->code_count * d->code_size; i++)
        m.codes[i] = model_round(d->dtype, 0.5 * test_random_normal(&random));
    return m;
}

/* Replaces the last layer, by least squares, so that f is near |p| - radius within the unit sphere: a shape to look at.
   Plain F32 only; one channel, level 0 (0.5 with a sigmoid). */
TEST_UNUSED static void model_fit_ball(model *m, const double *code, double radius)
{
    enum { POINTS = 400, MOST = 64 };
    static double a[MOST][MOST + 1];
    double features[MODEL_WIDTH], closest;
    test_random random = test_random_seed(77);
    int l = m->layers - 1, n = m->in[l], size = n + 1;
    if (size > MOST) exit(1);
    memset(a, 0, sizeof a);
    for (int i = 0; i < POINTS; i++) {
        float direction[3];
        double p[3], r = test_random_double(&random, 0.1, 1.0), target = r - radius;
        test_random_direction(&random, direction);
        for (int k = 0; k < 3; k++) p[k] = r * (double)direction[k];
        model_channels(m, m->params, code, p, NULL, features, &closest);
        features[n] = 1.0;
        for (int j = 0; j < size; j++) {
            for (int k = 0; k < size; k++) a[j][k] += features[j] * features[k];
            a[j][size] += features[j] * target;
        }
    }
    for (int j = 0; j < size; j++) a[j][j] += 1e-3;
    for (int j = 0; j < size; j++) /* Gauss and Jordan: the matrix is positive definite */
        for (int i = 0; i < size; i++) {
            double factor = i == j ? 1.0 - 1.0 / a[j][j] : a[i][j] / a[j][j];
            for (int k = size; k >= j; k--) a[i][k] -= factor * a[j][k];
        }
    int channel = m->sdf_channel >= 0 ? m->sdf_channel : 0;
    for (int k = 0; k < n; k++)
        m->params[m->offset[l] + (size_t)(channel * n + k)] = model_round(MODEL_F32, a[k][size]);
    m->params[m->offset[l] + (size_t)(m->out[l] * n + channel)] = model_round(MODEL_F32, a[n][size]);
}

/* ---- its file ---------------------------------------------------------------------------------------------------- */

typedef struct model_writer {
    char header[16384];
    size_t length, data, capacity;
    unsigned char *bytes; /* of the data */
    int dtype;
} model_writer;

TEST_UNUSED static void model_text(model_writer *w, const char *text)
{
    size_t n = strlen(text);
    if (w->length + n >= sizeof w->header) exit(1);
    memcpy(w->header + w->length, text, n + 1);
    w->length += n;
}

TEST_UNUSED static void model_meta(model_writer *w, const char *key, const char *value)
{
    char text[256];
    snprintf(text, sizeof text, "%s\"%s\":\"%s\"", w->header[w->length - 1] == '{' ? "" : ",", key, value);
    model_text(w, text);
}

TEST_UNUSED static void model_meta_number(model_writer *w, const char *key, double value)
{
    char text[64];
    snprintf(text, sizeof text, "%.17g", value);
    model_meta(w, key, text);
}

TEST_UNUSED static void model_number(model_writer *w, double x)
{
    float f = (float)x;
    uint32_t bits;
    int exponent, width = w->dtype == MODEL_F32 ? 4 : 2;
    memcpy(&bits, &f, sizeof bits);
    if (w->dtype == MODEL_BF16) bits >>= 16;
    if (w->dtype == MODEL_F16) {
        double mantissa = frexp(fabs(x), &exponent);
        uint32_t half = x == 0.0 ? 0 : (uint32_t)(exponent + 14) << 10 | ((uint32_t)ldexp(mantissa, 11) & 1023u);
        bits = half | (x < 0.0 ? 0x8000u : 0u);
    }
    if (w->data + 4 > w->capacity) {
        w->capacity = 2 * w->capacity + 4096;
        w->bytes = (unsigned char *)realloc(w->bytes, w->capacity);
        if (!w->bytes) exit(1);
    }
    for (int i = 0; i < width; i++) w->bytes[w->data++] = (unsigned char)(bits >> 8 * i);
}

/* rows 0: rank 1 */
TEST_UNUSED static void model_tensor(model_writer *w, const char *name, size_t rows, size_t columns, const double *x,
                                     const float *xf)
{
    static const char *const types[3] = {"F32", "F16", "BF16"};
    char text[256], shape[64];
    size_t begin = w->data;
    for (size_t i = 0; i < (rows ? rows : 1) * columns; i++) model_number(w, x ? x[i] : (double)xf[i]);
    if (rows)
        snprintf(shape, sizeof shape, "%lu,%lu", (unsigned long)rows, (unsigned long)columns);
    else
        snprintf(shape, sizeof shape, "%lu", (unsigned long)columns);
    snprintf(text, sizeof text, ",\"%s\":{\"dtype\":\"%s\",\"shape\":[%s],\"data_offsets\":[%lu,%lu]}", name,
             types[w->dtype], shape, (unsigned long)begin, (unsigned long)w->data);
    model_text(w, text);
}

TEST_UNUSED static void model_write_meta(const model *m, model_writer *w)
{
    static const char *const activations[6] = {"relu", "elu", "softplus", "sine", "tanh", "none"};
    static const char *const outputs[4] = {"tanh", "none", "sigmoid", "tanh:2"};
    static const char *const orders[3] = {"sin,cos", "cos_all,sin_all", "sin_all,cos_all"};
    const model_desc *d = &m->desc;
    char text[128];
    if (d->activation == DIST_ACTIVATION_SOFTPLUS)
        snprintf(text, sizeof text, "softplus:%.17g", d->scale);
    else if (d->activation == DIST_ACTIVATION_SINE && memcmp(&d->first_scale, &d->scale, sizeof d->scale) != 0)
        snprintf(text, sizeof text, "sine:%.17g,%.17g", d->first_scale, d->scale);
    else if (d->activation == DIST_ACTIVATION_SINE)
        snprintf(text, sizeof text, "sine:%.17g", d->scale);
    else
        snprintf(text, sizeof text, "%s", activations[d->activation]);
    if (d->activation || d->told) model_meta(w, "dist.activation", text);
    if (d->output || d->told) model_meta(w, "dist.output", outputs[d->output]);
    if (d->point_first || d->told) model_meta(w, "dist.input", d->point_first ? "xyz,code" : "code,xyz");
    if (d->skip_input_first || d->told) model_meta(w, "dist.skip_order", d->skip_input_first ? "input,x" : "x,input");
    if (d->skip_scale > 0.0) model_meta_number(w, "dist.skip_scale", d->skip_scale);
    if (d->fourier) {
        model_meta(w, "dist.encoding", "fourier");
        model_meta_number(w, "dist.encoding.levels", d->levels);
        if (d->base > 0.0) model_meta_number(w, "dist.encoding.base", d->base);
        if (d->no_raw || d->told) model_meta(w, "dist.encoding.raw", d->no_raw ? "0" : "1");
        if (d->order || d->told) model_meta(w, "dist.encoding.order", orders[d->order]);
    } else if (d->told) {
        model_meta(w, "dist.encoding", "none");
    }
    if (d->normed || d->told) model_meta(w, "dist.norm", d->normed ? "layer" : "none");
    if (d->norm_epsilon > 0.0) model_meta_number(w, "dist.norm.epsilon", d->norm_epsilon);
    if (fabs(d->level) > 0.0) model_meta_number(w, "dist.level", d->level);
    if (d->bound > 0.0) model_meta_number(w, "dist.bound", d->bound);
    if (d->clamp > 0.0) model_meta_number(w, "dist.clamp", d->clamp);
    if (d->channels) model_meta(w, "dist.channels", d->channels);
    if (!d->told) return;
    model_meta_number(w, "dist.code_size", d->code_size);
    size_t n = 0;
    text[0] = 0;
    for (int l = 1; l < m->layers; l++)
        if (d->skip >> l & 1) n += (size_t)snprintf(text + n, sizeof text - n, n ? ",%d" : "%d", l);
    model_meta(w, "dist.skip", text);
}

/* The safetensors bytes; give them back with free. */
TEST_UNUSED static unsigned char *model_file(const model *m, size_t *size)
{
    static const char *const spellings[3][2] = {
        {"weight", ""},
        {"weight_v", "weight_g"},
        {"parametrizations.weight.original1", "parametrizations.weight.original0"}};
    model_writer *w = (model_writer *)calloc(1, sizeof(model_writer));
    const model_desc *d = &m->desc;
    char name[96];
    const char *prefix = d->module ? "module." : "";
    if (!w) exit(1);
    w->dtype = d->dtype;
    model_text(w, "{\"__metadata__\":{");
    model_write_meta(m, w);
    model_text(w, "}");
    for (int l = 0; l < m->layers; l++) {
        size_t out = (size_t)m->out[l], in = (size_t)m->in[l], at = m->offset[l];
        const double *bias = m->params + at + out * in;
        snprintf(name, sizeof name, "%slin%d.%s", prefix, l, spellings[d->spelling][0]);
        model_tensor(w, name, out, in, d->spelling ? NULL : m->params + at, m->v + at);
        snprintf(name, sizeof name, "%slin%d.%s", prefix, l, spellings[d->spelling][1]);
        if (d->spelling) model_tensor(w, name, out, 1, NULL, m->g + at);
        snprintf(name, sizeof name, "%slin%d.bias", prefix, l);
        model_tensor(w, name, 0, out, bias, NULL);
        if (!model_is_normed(m, l)) continue;
        snprintf(name, sizeof name, "%snorm%d.weight", prefix, l);
        model_tensor(w, name, 0, out, bias + out, NULL);
        snprintf(name, sizeof name, "%snorm%d.bias", prefix, l);
        model_tensor(w, name, 0, out, bias + 2 * out, NULL);
    }
    if (d->code_count) model_tensor(w, "codes", (size_t)d->code_count, (size_t)d->code_size, m->codes, NULL);
    model_text(w, "}");
    *size = 8 + w->length + w->data;
    unsigned char *bytes = (unsigned char *)malloc(*size);
    if (!bytes) exit(1);
    for (size_t i = 0; i < 8; i++) bytes[i] = (unsigned char)((uint64_t)w->length >> 8 * i);
    memcpy(bytes + 8, w->header, w->length);
    memcpy(bytes + 8 + w->length, w->bytes, w->data);
    free(w->bytes);
    free(w);
    return bytes;
}

TEST_UNUSED static dist_net *model_load(dist_context *ctx, const model *m)
{
    size_t size;
    unsigned char *bytes = model_file(m, &size);
    dist_net *net = dist_net_load(ctx, bytes, size);
    free(bytes);
    return net;
}

/* ---- the cases --------------------------------------------------------------------------------------------------- */

static const model_desc model_cases[] = {
    {.name = "relu"},
    {.name = "elu", .activation = DIST_ACTIVATION_ELU},
    {.name = "softplus", .activation = DIST_ACTIVATION_SOFTPLUS, .first_scale = 1.0},
    {.name = "softplus:10", .activation = DIST_ACTIVATION_SOFTPLUS, .first_scale = 10.0},
    {.name = "sine:30", .activation = DIST_ACTIVATION_SINE, .first_scale = 30.0},
    {.name = "sine:6,2.5", .activation = DIST_ACTIVATION_SINE, .first_scale = 6.0, .scale = 2.5},
    {.name = "tanh", .activation = DIST_ACTIVATION_TANH},
    {.name = "no activation", .activation = DIST_ACTIVATION_NONE},
    {.name = "output none", .output = MODEL_NONE, .code_size = 2},
    {.name = "output sigmoid", .output = MODEL_SIGMOID, .level = 0.5, .code_size = 1},
    {.name = "output tanh twice", .output = MODEL_TANH_TWICE, .code_size = 3, .activation = DIST_ACTIVATION_TANH},
    {.name = "skip, code first", .skip = 4, .code_size = 5, .code_count = 2},
    {.name = "skip, point first", .skip = 4, .code_size = 5, .code_count = 2, .point_first = 1},
    {.name = "skip, input first", .skip = 4, .code_size = 5, .skip_input_first = 1},
    {.name = "skip, both first",
     .skip = 4,
     .code_size = 5,
     .skip_input_first = 1,
     .point_first = 1,
     .activation = DIST_ACTIVATION_ELU},
    {.name = "skip scale",
     .skip = 4,
     .code_size = 5,
     .skip_scale = 0.7071067811865475,
     .activation = DIST_ACTIVATION_SOFTPLUS,
     .first_scale = 5.0},
    {.name = "skip told", .skip = 4, .code_size = 3, .told = 1},
    {.name = "skip into every layer", .skip = 14, .code_size = 3, .told = 1, .activation = DIST_ACTIVATION_TANH},
    {.name = "fourier", .fourier = 1, .levels = 2},
    {.name = "fourier no raw", .fourier = 1, .levels = 3, .no_raw = 1, .code_size = 2, .base = 1.0},
    {.name = "fourier cos first", .fourier = 1, .levels = 2, .order = MODEL_COS_ALL, .code_size = 4, .skip = 4},
    {.name = "fourier cos first no raw",
     .fourier = 1,
     .levels = 2,
     .order = MODEL_COS_ALL,
     .no_raw = 1,
     .activation = DIST_ACTIVATION_NONE,
     .output = MODEL_NONE,
     .base = 1.5},
    {.name = "fourier sin first",
     .fourier = 1,
     .levels = 2,
     .order = MODEL_SIN_ALL,
     .skip = 4,
     .point_first = 1,
     .code_size = 3,
     .activation = DIST_ACTIVATION_TANH,
     .base = 1.25},
    {.name = "fourier sin first no raw", .fourier = 1, .levels = 2, .order = MODEL_SIN_ALL, .no_raw = 1, .told = 1},
    {.name = "layer norm", .normed = 1, .code_size = 3, .skip = 4},
    {.name = "layer norm epsilon",
     .normed = 1,
     .norm_epsilon = 0.1,
     .activation = DIST_ACTIVATION_TANH,
     .code_size = 2},
    {.name = "layer norm softplus", .normed = 1, .activation = DIST_ACTIVATION_SOFTPLUS, .first_scale = 4.0},
    {.name = "weight norm", .spelling = MODEL_WEIGHT_NORM, .code_size = 3, .skip = 2},
    {.name = "weight norm parametrized", .spelling = MODEL_PARAMETRIZED, .module = 1, .code_size = 3},
    {.name = "module", .module = 1, .code_size = 2, .code_count = 3, .normed = 1},
    {.name = "F16", .dtype = MODEL_F16, .code_size = 2, .code_count = 2, .activation = DIST_ACTIVATION_ELU},
    {.name = "BF16", .dtype = MODEL_BF16, .code_size = 2, .code_count = 2, .activation = DIST_ACTIVATION_TANH},
    {.name = "channels", .channels = "sdf,r,g,b", .output = MODEL_NONE, .code_size = 2},
    {.name = "distance last", .channels = "r,g,b,sdf", .output = MODEL_SIGMOID, .level = 0.25},
    {.name = "colors only", .channels = "r,g,b", .output = MODEL_SIGMOID, .code_size = 3, .point_first = 1},
    {.name = "level, bound, clamp", .level = 0.125, .bound = 1.5, .clamp = 0.3, .code_size = 2},
    {.name = "one layer", .hidden = 1, .width = 5, .activation = DIST_ACTIVATION_TANH, .code_size = 1},
    {.name = "width 37", .hidden = 4, .width = 37, .skip = 2, .code_size = 7},
    {.name = "width 64",
     .hidden = 2,
     .width = 64,
     .code_size = 16,
     .activation = DIST_ACTIVATION_SOFTPLUS,
     .first_scale = 20.0}};

enum { MODEL_CASES = sizeof model_cases / sizeof model_cases[0] };

/* A check that says for which case it failed. */
#define MODEL_CHECK(good, name, what, expected, got)                                                                   \
    model_check((good) ? 1 : 0, (name), (what), (double)(expected), (double)(got), __FILE__, __LINE__)

TEST_UNUSED static int model_check(int good, const char *name, const char *what, double expected, double got,
                                   const char *file, int line)
{
    if (!good && test_fail(file, line)) printf("%s: %s: expected %.9g, got %.9g\n", name, what, expected, got);
    return good;
}

#endif
