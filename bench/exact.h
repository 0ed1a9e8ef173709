/* SPDX-License-Identifier: MIT-0
   exact.h - a loaded network in double precision: value, gradient and the code's adjoint, written down plainly from
   README's "Model files", with nothing left out. It is what single precision is measured against. Include it after
   dist.h and common.h.

   Points go through in blocks of EXACT_BLOCK; arrays are (rows, EXACT_BLOCK). */
#ifndef DIST_BENCH_EXACT_H
#define DIST_BENCH_EXACT_H

enum { EXACT_BLOCK = 16 };

typedef struct exact {
    const dist_net *net;
    const float *code;
    double *bias;  /* (layers, max_rows), the code folded in */
    double *x[2];  /* (max_rows, B): a layer's input, and its adjoint */
    double *slope; /* (layers, max_rows, B): the activation's derivative */
    double *hat, *inverse; /* LayerNorm: (layers, max_rows, B), (layers, B) */
    double *delta; /* (max_rows, B) */
    double *point, *d_point; /* (point_size, B) */
    double *fold;  /* (layers, max_rows): adjoints of the biases */
} exact;

static inline double *exact_take(size_t n)
{
    return (double *)take(n, sizeof(double));
}

static inline exact exact_create(const dist_net *net, const float *code)
{
    exact e;
    size_t rows = (size_t)net->max_rows, layers = (size_t)net->layers;
    e.net = net;
    e.code = code;
    e.bias = exact_take(layers * rows);
    e.x[0] = exact_take(rows * EXACT_BLOCK);
    e.x[1] = exact_take(rows * EXACT_BLOCK);
    e.slope = exact_take(layers * rows * EXACT_BLOCK);
    e.hat = exact_take(layers * rows * EXACT_BLOCK);
    e.inverse = exact_take(layers * EXACT_BLOCK);
    e.delta = exact_take(rows * EXACT_BLOCK);
    e.point = exact_take((size_t)net->point_size * EXACT_BLOCK);
    e.d_point = exact_take((size_t)net->point_size * EXACT_BLOCK);
    e.fold = exact_take(layers * rows);
    for (size_t l = 0; l < layers; l++) {
        const disti_linear *layer = &net->layer[l];
        for (size_t o = 0; o < (size_t)layer->out; o++) {
            const float *w = net->params + layer->weight + o * (size_t)layer->in + layer->code_column;
            double sum = 0;
            for (int j = 0; j < layer->code; j++) { sum += (double)w[j] * (double)code[j]; }
            e.bias[l * rows + o] = (double)net->params[layer->bias + o] + (double)layer->scale * sum;
        }
    }
    return e;
}

static inline void exact_destroy(exact *e)
{
    free(e->bias);
    free(e->x[0]);
    free(e->x[1]);
    free(e->slope);
    free(e->hat);
    free(e->inverse);
    free(e->delta);
    free(e->point);
    free(e->d_point);
    free(e->fold);
}

/* Rows of the encoded point; with d_points (3, B) its adjoint from e->d_point instead. */
static inline void exact_encode(const exact *e, const double *points, double *d_points)
{
    const dist_net *net = e->net;
    for (int axis = 0; axis < 3; axis++) {
        for (int c = 0; c < EXACT_BLOCK; c++) {
            double p = points[3 * c + axis], sum = 0;
            if (net->raw) {
                e->point[axis * EXACT_BLOCK + c] = p;
                sum = e->d_point[axis * EXACT_BLOCK + c];
            }
            for (int k = 0; k < net->levels; k++) {
                double factor = ldexp(net->base, k);
                int s = disti_encoding_row(net, k, axis, 0) * EXACT_BLOCK + c;
                int co = disti_encoding_row(net, k, axis, 1) * EXACT_BLOCK + c;
                e->point[s] = sin(factor * p);
                e->point[co] = cos(factor * p);
                sum += factor * (e->point[co] * e->d_point[s] - e->point[s] * e->d_point[co]);
            }
            if (d_points) { d_points[axis * EXACT_BLOCK + c] = sum; }
        }
    }
}

/* y += scale * w x for `count` columns of one row of weights; backward: d_x += scale * w^T delta. What stays the same
   in the loop is copied, since it might overlap the rest for all that a compiler knows. */
static inline void exact_row(const float *w, int count, double scale, const double *x, double *y)
{
    double sum[EXACT_BLOCK];
    memcpy(sum, y, sizeof sum);
    for (int k = 0; k < count; k++) {
        double by = scale * (double)w[k];
        for (int c = 0; c < EXACT_BLOCK; c++) { sum[c] += by * x[k * EXACT_BLOCK + c]; }
    }
    memcpy(y, sum, sizeof sum);
}

static inline void exact_row_backward(const float *w, int count, double scale, const double *delta, double *d_x)
{
    double d[EXACT_BLOCK];
    memcpy(d, delta, sizeof d);
    for (int k = 0; k < count; k++) {
        double by = scale * (double)w[k];
        for (int c = 0; c < EXACT_BLOCK; c++) { d_x[k * EXACT_BLOCK + c] += by * d[c]; }
    }
}

static inline double exact_activate(const dist_net *net, int l, double x, double *slope)
{
    double scale = (double)(l == 0 ? net->first_scale : net->scale), y = x;
    *slope = 1;
    switch (net->activation) {
    case DIST_ACTIVATION_RELU: y = fmax(x, 0), *slope = x > 0 ? 1 : 0; break;
    case DIST_ACTIVATION_ELU: y = x > 0 ? x : expm1(x), *slope = x > 0 ? 1 : exp(x); break;
    case DIST_ACTIVATION_SOFTPLUS:
        y = scale * x > 40 ? x : log1p(exp(scale * x)) / scale, *slope = 1 / (1 + exp(-scale * x));
        break;
    case DIST_ACTIVATION_SINE: y = sin(scale * x), *slope = scale * cos(scale * x); break;
    case DIST_ACTIVATION_TANH: y = tanh(x), *slope = 1 - y * y; break;
    default: break;
    }
    return y;
}

/* Forward y = gamma hat + beta, hat = (y - mean) / sigma, in place; and its adjoint
   d_y = (d_hat - mean(d_hat) - hat mean(d_hat hat)) / sigma with d_hat = gamma d. */
static inline void exact_norm(const exact *e, int l, double *y, int backward)
{
    const dist_net *net = e->net;
    const disti_linear *layer = &net->layer[l];
    const float *gamma = net->params + layer->norm_weight, *beta = net->params + layer->norm_bias;
    double *hat = e->hat + (size_t)l * (size_t)net->max_rows * EXACT_BLOCK, *inverse = e->inverse + l * EXACT_BLOCK;
    for (int c = 0; c < EXACT_BLOCK; c++) {
        double mean = 0, second = 0;
        for (int o = 0; o < layer->out; o++) {
            double v = y[o * EXACT_BLOCK + c] * (backward ? (double)gamma[o] : 1);
            mean += v / layer->out;
            if (backward) { second += v * hat[o * EXACT_BLOCK + c] / layer->out; }
        }
        for (int o = 0; o < layer->out && !backward; o++) {
            double v = y[o * EXACT_BLOCK + c] - mean;
            second += v * v / layer->out;
        }
        if (!backward) { inverse[c] = 1 / sqrt(second + (double)net->norm_epsilon); }
        for (int o = 0; o < layer->out; o++) {
            double *v = y + o * EXACT_BLOCK + c, *h = hat + o * EXACT_BLOCK + c;
            if (backward) {
                *v = ((double)gamma[o] * *v - mean - *h * second) * inverse[c];
            } else {
                *h = (*v - mean) * inverse[c];
                *v = (double)gamma[o] * *h + (double)beta[o];
            }
        }
    }
}

/* f at a block of points (B, 3) into f (B) and, unless NULL, df/dpoint (B, 3). seed (B), unless NULL: adds
   sum_c seed_c df_c/d(bias) to e->fold, for exact_code. */
static inline void exact_block(exact *e, const double *points, double *f, double *gradient, const double *seed)
{
    const dist_net *net = e->net;
    size_t rows = (size_t)net->max_rows, area = rows * EXACT_BLOCK;
    int last = net->layers - 1;
    double slope[EXACT_BLOCK];
    exact_encode(e, points, NULL);
    for (int l = 0; l < last; l++) {
        const disti_linear *layer = &net->layer[l];
        const double *x = e->x[l & 1];
        double *y = e->x[(l + 1) & 1];
        for (int o = 0; o < layer->out; o++) {
            const float *w = net->params + layer->weight + (size_t)o * (size_t)layer->in;
            for (int c = 0; c < EXACT_BLOCK; c++) { y[o * EXACT_BLOCK + c] = e->bias[(size_t)l * rows + (size_t)o]; }
            exact_row(w + layer->x_column, layer->prev, (double)layer->scale, x, y + o * EXACT_BLOCK);
            exact_row(w + layer->point_column, layer->point, (double)layer->scale, e->point, y + o * EXACT_BLOCK);
        }
        if (net->normed) { exact_norm(e, l, y, 0); }
        for (int i = 0; i < layer->out * EXACT_BLOCK; i++) {
            y[i] = exact_activate(net, l, y[i], e->slope + (size_t)l * area + i);
        }
    }
    const disti_linear *end = &net->layer[last];
    const float *w = net->params + end->weight + (size_t)net->sdf_channel * (size_t)end->in;
    for (int c = 0; c < EXACT_BLOCK; c++) {
        f[c] = e->bias[(size_t)last * rows + (size_t)net->sdf_channel];
        slope[c] = 1;
    }
    exact_row(w + end->x_column, end->prev, (double)end->scale, e->x[last & 1], f);
    exact_row(w + end->point_column, end->point, (double)end->scale, e->point, f);
    for (int c = 0; c < EXACT_BLOCK; c++) {
        int times = net->output == DISTI_OUTPUT_TANH ? 1 : net->output == DISTI_OUTPUT_TANH_TWICE ? 2 : 0;
        for (int k = 0; k < times; k++) {
            f[c] = tanh(f[c]);
            slope[c] *= 1 - f[c] * f[c];
        }
        if (net->output == DISTI_OUTPUT_SIGMOID) {
            f[c] = 1 / (1 + exp(-f[c]));
            slope[c] = f[c] * (1 - f[c]);
        }
        f[c] -= (double)net->level;
    }
    if (!gradient) { return; }
    memset(e->d_point, 0, (size_t)net->point_size * EXACT_BLOCK * sizeof(double));
    memset(e->x[last & 1], 0, area * sizeof(double));
    exact_row_backward(w + end->x_column, end->prev, (double)end->scale, slope, e->x[last & 1]);
    exact_row_backward(w + end->point_column, end->point, (double)end->scale, slope, e->d_point);
    for (int c = 0; c < EXACT_BLOCK && seed; c++) {
        e->fold[(size_t)last * rows + (size_t)net->sdf_channel] += seed[c] * slope[c];
    }
    for (int l = last - 1; l >= 0; l--) {
        const disti_linear *layer = &net->layer[l];
        double *d_x = e->x[l & 1];
        for (int i = 0; i < layer->out * EXACT_BLOCK; i++) {
            e->delta[i] = e->x[(l + 1) & 1][i] * e->slope[(size_t)l * area + (size_t)i];
        }
        if (net->normed) { exact_norm(e, l, e->delta, 1); }
        memset(d_x, 0, area * sizeof(double));
        for (int o = 0; o < layer->out; o++) {
            const double *delta = e->delta + o * EXACT_BLOCK;
            w = net->params + layer->weight + (size_t)o * (size_t)layer->in;
            exact_row_backward(w + layer->x_column, layer->prev, (double)layer->scale, delta, d_x);
            exact_row_backward(w + layer->point_column, layer->point, (double)layer->scale, delta, e->d_point);
            for (int c = 0; c < EXACT_BLOCK && seed; c++) {
                e->fold[(size_t)l * rows + (size_t)o] += seed[c] * delta[c];
            }
        }
    }
    double d_points[3 * EXACT_BLOCK];
    exact_encode(e, points, d_points);
    for (int c = 0; c < EXACT_BLOCK; c++) {
        for (int a = 0; a < 3; a++) { gradient[3 * c + a] = d_points[a * EXACT_BLOCK + c]; }
    }
}

/* The same for n points. */
static inline void exact_eval(exact *e, size_t n, const double *points, double *f, double *gradient, const double *seed)
{
    double p[3 * EXACT_BLOCK], g[3 * EXACT_BLOCK], v[EXACT_BLOCK], s[EXACT_BLOCK];
    memset(p, 0, sizeof p);
    for (size_t first = 0; first < n; first += EXACT_BLOCK) {
        size_t count = n - first < EXACT_BLOCK ? n - first : EXACT_BLOCK;
        memset(s, 0, sizeof s);
        memcpy(p, points + 3 * first, 3 * count * sizeof *p);
        if (seed) { memcpy(s, seed + first, count * sizeof *s); }
        exact_block(e, p, v, gradient ? g : NULL, seed ? s : NULL);
        memcpy(f + first, v, count * sizeof *v);
        if (gradient) { memcpy(gradient + 3 * first, g, 3 * count * sizeof *g); }
    }
}

static inline void exact_forget(exact *e)
{
    memset(e->fold, 0, (size_t)e->net->layers * (size_t)e->net->max_rows * sizeof(double));
}

/* What the seeds since then come to for the code: adds to d_code. */
static inline void exact_code(const exact *e, double *d_code)
{
    const dist_net *net = e->net;
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        for (int o = 0; o < layer->out; o++) {
            const float *w = net->params + layer->weight + (size_t)o * (size_t)layer->in + layer->code_column;
            double by = (double)layer->scale * e->fold[(size_t)l * (size_t)net->max_rows + (size_t)o];
            for (int j = 0; j < layer->code; j++) { d_code[j] += by * (double)w[j]; }
        }
    }
}

#endif
