/* SPDX-License-Identifier: MIT-0
   train.c - trains a small decoder on families of shapes (shapes.h), as DeepSDF does: one network for all of them, one
   code for each, learned together from samples of the distance. Nothing but the library's own backward pass and Adam.

       cc -O2 -fopenmp train.c -o train -lm

   The result follows from the options and the seed: the same bits for any number of threads on one instruction set,
   unless
   --minutes ends the training by the clock. */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#define COMMON_NO_MODEL
#include "common.h"
#include "shapes.h"

static const char usage[] =
    "train [options] --out FILE.safetensors     trains a decoder\n"
    "train --evaluate FILE.safetensors          measures one: Chamfer distance x 1000, as csv\n"
    "train --color SHAPES.safetensors --out FILE.safetensors     trains a texture for a decoder made by the first\n"
    "\n"
    "  --families LIST    of sofas,planes,tables,cars (default all; for --evaluate those it was trained on)\n"
    "  --shapes N         shapes of each family (default 64)\n"
    "  --layers N         hidden layers (default 5; a texture: 3)\n"
    "  --width N          units of each (default 128; a texture: 64)\n"
    "  --code N           numbers of a code (default 32; a texture: 8 beside the shape's)\n"
    "  --steps N          steps of Adam (default 20000, a texture too)\n"
    "  --epochs N         the same in passes over all shapes\n"
    "  --minutes M        the same by the clock: not reproducible\n"
    "  --group N          shapes a step (default 64; a texture: 16)\n"
    "  --batch N          points of each of them (default 256)\n"
    "  --pool N           points kept for each shape (default 24000; a texture: 2000)\n"
    "  --rate R           Adam's rate at the start, falling to nothing along a cosine (default 0.003)\n"
    "  --code-rate R      the same for the codes, which have their turn more rarely (default 0.015)\n"
    "  --prior W          weight of |code|^2 (default 0.0001)\n"
    "  --eikonal W        weight of (|grad f| - 1)^2 at the samples (default 0: none)\n"
    "  --seed S           (default 1)\n"
    "  --threads N        (default all)\n"
    "  --resume FILE      goes on with a model's weights and codes\n"
    "  --out FILE         where the model goes\n"
    "  --header FILE.h    the same as C source\n"
    "  --color FILE       trains a texture for this decoder of the same families and number of shapes: colorings of\n"
    "                     shapes.h, any of them on any shape, one color code each\n"
    "  --evaluate FILE    measures instead of training\n"
    "  --count N          training shapes of each family that are measured (default 16)\n"
    "  --held-out N       shapes of each family that were never seen, fitted and measured (default 16; training: 0)\n"
    "  --samples N        points on each surface (default 30000)\n"
    "  --resolution N     cells along each side for extraction (default 128)\n"
    "  --iterations N     steps of fitting a code (default 400)\n";

typedef struct settings {
    int families[SHAPE_FAMILIES];
    int family_count;
    int shapes, layers, width, code, steps, epochs, group, batch, pool, threads;
    int count, held_out, samples, resolution, iterations;
    unsigned seed;
    double minutes;
    float rate, code_rate, prior, eikonal;
    const char *resume, *out, *header, *evaluate, *color;
} settings;

/* ---- samples
 * ---------------------------------------------------------------------------------------------------------- */

/* n points on a field's surface; 0 if there is none. */
static int surface_points(dist_context *ctx, const dist_field *field, int resolution, unsigned seed, size_t n,
                          float *points)
{
    dist_mesh_desc how;
    memset(&how, 0, sizeof how);
    how.resolution = resolution;
    dist_mesh *mesh = dist_mesh_extract(ctx, field, &how);
    check(ctx);
    int found = mesh->triangle_count > 0;
    if (found) dist_mesh_sample(ctx, mesh, seed, n, points);
    check(ctx);
    dist_mesh_destroy(mesh);
    return found;
}

/* Points with their distances, those inside the shape first. */
typedef struct pool {
    size_t count, inside;
    float *points, *sdf;
} pool;

static void pool_free(pool *p)
{
    free(p->points);
    free(p->sdf);
}

/* Nine points in ten lie about the surface, every coordinate off it by a random amount with deviation 0.05 or 0.0125;
   the tenth is anywhere in the sphere, so that nothing grows where no surface is. */
static pool pool_make(dist_context *ctx, int family, unsigned index, size_t count)
{
    shape s;
    shape_make(&s, family, index);
    dist_field field = shape_field(&s);
    rng r = rng_begin((unsigned long long)index * SHAPE_FAMILIES + (unsigned)family);
    float *points = take_floats(3 * count);
    float *sdf = take_floats(count);
    surface_points(ctx, &field, 64, index + 1, count, points);
    for (size_t i = 0; i < count; i++) {
        float *p = points + 3 * i;
        float spread = i % 2 ? 0.05f : 0.0125f;
        if (i % 10 != 9) {
            for (int k = 0; k < 3; k++) p[k] += spread * rng_normal(&r);
            continue;
        }
        do {
            for (int k = 0; k < 3; k++) p[k] = 2.0f * rng_uniform(&r) - 1.0f;
        } while (p[0] * p[0] + p[1] * p[1] + p[2] * p[2] > 1.0f);
    }
    dist_field_eval(ctx, &field, count, points, sdf, NULL);
    check(ctx);

    pool made;
    made.count = count;
    made.inside = 0;
    made.points = take_floats(3 * count);
    made.sdf = take_floats(count);
    for (size_t i = 0; i < count; i++) made.inside += sdf[i] < 0.0f;
    size_t inner = 0, outer = made.inside;
    for (size_t i = 0; i < count; i++) {
        size_t to = sdf[i] < 0.0f ? inner++ : outer++;
        memcpy(made.points + 3 * to, points + 3 * i, 3 * sizeof *points);
        made.sdf[to] = sdf[i];
    }
    free(points);
    free(sdf);
    return made;
}

/* n points, half of them inside. */
static void pool_draw(const pool *p, rng *r, size_t n, float *points, float *sdf)
{
    for (size_t i = 0; i < n; i++) {
        int inner = p->inside > 0 && (i % 2 == 0 || p->inside == p->count);
        size_t from = inner ? rng_index(r, p->inside) : p->inside + rng_index(r, p->count - p->inside);
        memcpy(points + 3 * i, p->points + 3 * from, 3 * sizeof *points);
        sdf[i] = p->sdf[from];
    }
}

/* ---- loss
 * ------------------------------------------------------------------------------------------------------------- */

/* forward   L = mean_i |clamp(f_i) - clamp(s_i)|                                                        (DeepSDF, eq.
   4) backward  d_f_i = sign(clamp(f_i) - clamp(s_i)) / n; unlike the clamp's own derivative this does not vanish where
   f_i lies beyond the clamp and should not. */
typedef struct clamped_loss {
    const float *target;
    float *loss; /* each point's share, so that the sum does not depend on who worked when */
    float clamp, scale;
} clamped_loss;

static float clamped(float x, float limit)
{
    return x < -limit ? -limit : x > limit ? limit : x;
}

static void clamped_loss_seed(void *user, size_t first, size_t count, const float *sdf, const float *gradient,
                              float *d_sdf)
{
    const clamped_loss *l = (const clamped_loss *)user;
    (void)gradient;
    for (size_t i = 0; i < count; i++) {
        float error = clamped(sdf[i], l->clamp) - clamped(l->target[first + i], l->clamp);
        l->loss[first + i] = fabsf(error);
        d_sdf[i] = error > 0.0f ? l->scale : error < 0.0f ? -l->scale : 0.0f;
    }
}

static double mean_of(size_t n, const float *x)
{
    double sum = 0.0;
    for (size_t i = 0; i < n; i++) sum += (double)x[i];
    return sum / (double)n;
}

/* ---- training
 * --------------------------------------------------------------------------------------------------------- */

static const float clamp_limit = 0.1f;

typedef struct trainer {
    const settings *how;
    dist_context *ctx;
    dist_net *net;
    dist_shape *shape;
    size_t shape_count, weight_count, code_size;
    pool *pools;
    float *weights, *d_weights, *codes, *d_code;
    dist_adam adam, *code_adam; /* a code's moments move only when its shape has its turn */
    float *points, *target, *d_sdf, *loss;
    size_t *order; /* the shapes in the order of this pass */
    size_t next;
    double slope_error; /* mean (|grad f| - 1)^2 of the last steps, where --eikonal asks for it */
    rng random;
} trainer;

static dist_net *net_make(dist_context *ctx, const settings *how)
{
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = how->layers;
    desc.width = how->width;
    desc.skip = how->layers > 2 ? (how->layers + 1) / 2 : 0;
    desc.code_size = how->code;
    desc.code_count = how->shapes * how->family_count;
    desc.clamp = clamp_limit;
    desc.seed = how->seed;
    return how->resume ? dist_net_load_file(ctx, how->resume) : dist_net_create(ctx, &desc);
}

/* A random code of about length 1, half of it shared by the family: to tell families apart is the first thing to learn,
   and passes are saved where the codes say it from the start. */
static void code_start(const settings *how, size_t family, size_t k, size_t size, float *code)
{
    rng shared = rng_begin(how->seed + 1000000ULL * (family + 1));
    rng own = rng_begin(how->seed + 1000000ULL * (k + SHAPE_HELD_OUT));
    float spread = sqrtf(0.5f / (float)size);
    for (size_t j = 0; j < size; j++) code[j] = spread * (rng_normal(&shared) + rng_normal(&own));
}

static void trainer_begin(trainer *t, dist_context *ctx, const settings *how)
{
    memset(t, 0, sizeof *t);
    t->how = how;
    t->ctx = ctx;
    t->net = net_make(ctx, how);
    check(ctx);
    t->shape_count = (size_t)how->shapes * (size_t)how->family_count;
    t->code_size = (size_t)dist_net_code_size(t->net);
    t->weight_count = dist_net_weight_count(t->net);
    if ((size_t)dist_net_code_count(t->net) != t->shape_count || t->code_size == 0) {
        fail("%s has %d codes; --shapes and --families ask for %.0f", how->resume, dist_net_code_count(t->net),
             (double)t->shape_count);
    }
    t->random = rng_begin(how->seed);
    t->weights = take_floats(t->weight_count);
    memcpy(t->weights, dist_net_weights(t->net), t->weight_count * sizeof(float));
    t->d_weights = take_floats(t->weight_count);
    t->adam.moments = take_floats(2 * t->weight_count);
    t->codes = take_floats(t->shape_count * t->code_size);
    t->d_code = take_floats(t->code_size);
    t->code_adam = (dist_adam *)take(t->shape_count, sizeof *t->code_adam);
    t->order = (size_t *)take(t->shape_count, sizeof *t->order);
    t->pools = (pool *)take(t->shape_count, sizeof *t->pools);
    progress p = progress_begin("sampling the shapes");
    for (size_t k = 0; k < t->shape_count; k++) {
        float *code = t->codes + k * t->code_size;
        code_start(how, k / (size_t)how->shapes, k, t->code_size, code);
        if (how->resume) memcpy(code, dist_net_code(t->net, (int)k), t->code_size * sizeof(float));
        t->code_adam[k].moments = take_floats(2 * t->code_size);
        t->order[k] = k;
        t->pools[k] = pool_make(ctx, how->families[k / (size_t)how->shapes], (unsigned)(k % (size_t)how->shapes),
                                (size_t)how->pool);
        progress_show(&p, (double)k, (double)t->shape_count, NULL, 0);
    }
    progress_end(&p);
    t->next = t->shape_count;
    t->shape = dist_shape_create(ctx, t->net, t->codes);
    check(ctx);
    size_t batch = (size_t)how->batch;
    t->points = take_floats(3 * batch);
    t->target = take_floats(batch);
    t->d_sdf = take_floats(batch);
    t->loss = take_floats(batch);
}

static void trainer_end(trainer *t)
{
    for (size_t k = 0; k < t->shape_count; k++) {
        pool_free(&t->pools[k]);
        free(t->code_adam[k].moments);
    }
    dist_shape_destroy(t->shape);
    dist_net_destroy(t->net);
    free(t->adam.moments);
    free(t->weights);
    free(t->d_weights);
    free(t->codes);
    free(t->d_code);
    free(t->code_adam);
    free(t->order);
    free(t->pools);
    free(t->points);
    free(t->target);
    free(t->d_sdf);
    free(t->loss);
}

/* The next shape of this pass; a new pass begins in a new order. */
static size_t trainer_next(trainer *t)
{
    if (t->next == t->shape_count) {
        for (size_t i = t->shape_count - 1; i > 0; i--) {
            size_t j = rng_index(&t->random, i + 1);
            size_t moved = t->order[i];
            t->order[i] = t->order[j];
            t->order[j] = moved;
        }
        t->next = 0;
    }
    return t->order[t->next++];
}

/* One step on `group` shapes. The prior grows over the first tenth, so that codes first find their places.
   Returns the mean loss without the prior. */
static double trainer_step(trainer *t, double done)
{
    const settings *how = t->how;
    size_t batch = (size_t)how->batch;
    float decay = 0.5f + 0.5f * cosf(PI * (float)done) + 1e-3f;
    float prior = how->prior * (float)(done < 0.1 ? done / 0.1 : 1.0);
    double loss = 0.0, slope_error = 0.0;
    memset(t->d_weights, 0, t->weight_count * sizeof(float));
    for (int i = 0; i < how->group; i++) {
        size_t k = trainer_next(t);
        float *code = t->codes + k * t->code_size;
        clamped_loss l = {t->target, t->loss, clamp_limit, 1.0f / (float)batch};
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        grads.code = t->d_code;
        grads.weights = t->d_weights;
        pool_draw(&t->pools[k], &t->random, batch, t->points, t->target);
        memset(t->d_code, 0, t->code_size * sizeof(float));
        dist_loss_code(t->code_size, code, prior, t->d_code);
        dist_shape_set_code(t->shape, code);
        dist_field field = dist_shape_field(t->shape);
        dist_field_backward(t->ctx, &field, batch, t->points, t->d_sdf, clamped_loss_seed, &l, NULL, &grads);
        if (how->eikonal > 0.0f) {
            float term;
            dist_field_eikonal(t->ctx, &field, batch, t->points, how->eikonal, &term, &grads);
            slope_error += (double)(term / how->eikonal) / how->group;
        }
        t->code_adam[k].rate = how->code_rate * decay;
        dist_adam_step(&t->code_adam[k], t->code_size, code, t->d_code);
        loss += mean_of(batch, t->loss) / how->group;
    }
    t->slope_error = done > 0.0 ? 0.95 * t->slope_error + 0.05 * slope_error : slope_error;
    t->adam.rate = how->rate * decay;
    dist_adam_step(&t->adam, t->weight_count, t->weights, t->d_weights);
    dist_net_set_weights(t->ctx, t->net, t->weights);
    check(t->ctx);
    return loss;
}

static void train(dist_context *ctx, const settings *how, trainer *t)
{
    double start = seconds_now();
    trainer_begin(t, ctx, how);
    double began = seconds_now();
    double steps = how->epochs ? ceil((double)how->epochs * (double)t->shape_count / how->group) : how->steps;
    progress p = progress_begin("training");
    double loss = 0.0, done = 0.0;
    int step = 0;
    for (; done < 1.0; step++) {
        double now = trainer_step(t, done);
        double keep = step < 200 ? (double)step / (step + 1) : 0.995;
        loss = keep * loss + (1.0 - keep) * now;
        done = how->minutes > 0.0 ? (seconds_now() - began) / (60.0 * how->minutes) : (step + 1) / steps;
        progress_show(&p, done, 1.0, "loss", loss);
    }
    progress_end(&p);
    for (size_t k = 0; k < t->shape_count; k++) dist_net_set_code(ctx, t->net, (int)k, t->codes + k * t->code_size);
    check(ctx);
    double squares = 0.0;
    for (size_t i = 0; i < t->shape_count * t->code_size; i++) squares += (double)t->codes[i] * (double)t->codes[i];
    printf("%.0f shapes, %.0f weights, %d steps in %.0f s (sampling %.0f s): loss %.5f, length of a code %.3f\n",
           (double)t->shape_count, (double)t->weight_count, step, seconds_now() - began, began - start, loss,
           sqrt(squares / (double)t->shape_count));
    if (how->eikonal > 0.0f) printf("|grad f| at the samples is off 1 by %.4f (rms)\n", sqrt(t->slope_error));
}

/* The model file as little-endian words, for programs that carry it with them. what: "model" or "texture". */
static void write_header(dist_context *ctx, const dist_net *net, const char *what, const char *path)
{
    size_t size = 0;
    dist_net_save(ctx, net, NULL, 0, &size);
    unsigned char *bytes = (unsigned char *)take(size + 4, 1);
    dist_net_save(ctx, net, bytes, size, &size);
    check(ctx);
    make_folders(path);
    FILE *file = open_file(path, "wb");
    fprintf(file, "/* made by examples/train.c: %s of %d %s, as a safetensors file in little-endian words */\n",
            strcmp(what, "model") == 0 ? "a decoder" : "a texture", dist_net_code_count(net),
            strcmp(what, "model") == 0 ? "shapes" : "colorings");
    fprintf(file, "static const unsigned long %s_bytes = %luul;\nstatic const unsigned %s_words[] = {\n", what,
            (unsigned long)size, what);
    for (size_t i = 0; i < size; i += 4) {
        unsigned long word = (unsigned long)bytes[i] | (unsigned long)bytes[i + 1] << 8 |
                             (unsigned long)bytes[i + 2] << 16 | (unsigned long)bytes[i + 3] << 24;
        fprintf(file, "0x%lxu,%s", word, i / 4 % 12 == 11 ? "\n" : "");
    }
    fputs("\n};\n", file);
    close_file(file, path);
    free(bytes);
}

/* ---- texture ----------------------------------------------------------------------------------------------------- */

/* rgb = g(shape code, color code, point), learned on points about the surfaces with the decoder's own codes held still.
   Every step pairs shapes with colorings at random, so that either code can go with any other. */
typedef struct painter {
    dist_net *net;
    dist_shape *shape;
    pool *pools;
    size_t shape_count, own, size; /* numbers of the shape's code, and of both codes */
    float *codes;                  /* (SHAPE_COLORINGS, size - own) */
    float *weights, *d_weights, *d_code, *code;
    float *points, *color, *target, *d_color;
    dist_adam adam, code_adam[SHAPE_COLORINGS];
    rng random;
} painter;

static void painter_begin(painter *t, dist_context *ctx, const settings *how, const dist_net *decoder)
{
    dist_net_desc desc;
    memset(t, 0, sizeof *t);
    memset(&desc, 0, sizeof desc);
    t->own = (size_t)dist_net_code_size(decoder);
    t->size = t->own + (size_t)how->code;
    t->shape_count = (size_t)(how->shapes * how->family_count);
    if (dist_net_code_count(decoder) != (int)t->shape_count)
        fail("the decoder has %d codes, not %d of each of %d families", dist_net_code_count(decoder), how->shapes,
             how->family_count);
    desc.layers = how->layers;
    desc.width = how->width;
    desc.code_size = (int)t->size;
    desc.code_count = SHAPE_COLORINGS;
    desc.levels = 3;
    desc.color = 1;
    desc.seed = how->seed;
    t->net = dist_net_create(ctx, &desc);
    check(ctx);
    t->random = rng_begin(how->seed);
    t->pools = (pool *)take(t->shape_count, sizeof *t->pools);
    progress p = progress_begin("sampling the shapes");
    for (size_t k = 0; k < t->shape_count; k++) {
        t->pools[k] = pool_make(ctx, how->families[k / (size_t)how->shapes], (unsigned)(k % (size_t)how->shapes),
                                (size_t)how->pool);
        progress_show(&p, (double)k, (double)t->shape_count, NULL, 0);
    }
    progress_end(&p);
    size_t count = dist_net_weight_count(t->net), batch = (size_t)how->batch, extra = t->size - t->own;
    t->weights = take_floats(count);
    memcpy(t->weights, dist_net_weights(t->net), count * sizeof(float));
    t->d_weights = take_floats(count);
    t->adam.moments = take_floats(2 * count);
    t->codes = take_floats(SHAPE_COLORINGS * extra);
    for (size_t i = 0; i < SHAPE_COLORINGS; i++) t->code_adam[i].moments = take_floats(2 * extra);
    for (size_t i = 0; i < SHAPE_COLORINGS * extra; i++) t->codes[i] = 0.5f * rng_normal(&t->random);
    t->d_code = take_floats(t->size);
    t->code = take_floats(t->size);
    t->points = take_floats(12 * batch);
    t->color = t->points + 3 * batch;
    t->target = t->color + 3 * batch;
    t->d_color = t->target + 3 * batch;
    t->shape = dist_shape_create(ctx, t->net, NULL);
    check(ctx);
}

static void painter_end(painter *t)
{
    for (size_t k = 0; k < t->shape_count; k++) pool_free(&t->pools[k]);
    for (size_t i = 0; i < SHAPE_COLORINGS; i++) free(t->code_adam[i].moments);
    free(t->adam.moments);
    free(t->pools);
    free(t->weights);
    free(t->d_weights);
    free(t->codes);
    free(t->d_code);
    free(t->code);
    free(t->points);
    dist_shape_destroy(t->shape);
    dist_net_destroy(t->net);
}

/* A shape in a coloring: both codes into the shape, points with the colors they should have and those they have. */
static void painter_draw(painter *t, dist_context *ctx, const settings *how, const dist_net *decoder, size_t k,
                         size_t coloring)
{
    size_t batch = (size_t)how->batch, extra = t->size - t->own;
    const pool *from = &t->pools[k];
    shape_coloring c = shape_coloring_make(how->families[k / (size_t)how->shapes], (unsigned)coloring);
    for (size_t i = 0; i < batch; i++) {
        memcpy(t->points + 3 * i, from->points + 3 * rng_index(&t->random, from->count), 3 * sizeof(float));
        shape_color(&c, t->points + 3 * i, t->target + 3 * i);
    }
    memcpy(t->code, dist_net_code(decoder, (int)k), t->own * sizeof(float));
    memcpy(t->code + t->own, t->codes + coloring * extra, extra * sizeof(float));
    dist_shape_set_code(t->shape, t->code);
    dist_field field = dist_shape_field(t->shape);
    dist_color_eval(ctx, &field, batch, t->points, t->color);
}

static double painter_step(painter *t, dist_context *ctx, const settings *how, const dist_net *decoder, double done)
{
    size_t batch = (size_t)how->batch, extra = t->size - t->own, count = dist_net_weight_count(t->net);
    float decay = 0.5f + 0.5f * cosf(PI * (float)done) + 1e-3f;
    double loss = 0.0;
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    grads.code = t->d_code;
    grads.weights = t->d_weights;
    memset(t->d_weights, 0, count * sizeof(float));
    for (int i = 0; i < how->group; i++) {
        size_t coloring = rng_index(&t->random, SHAPE_COLORINGS);
        painter_draw(t, ctx, how, decoder, rng_index(&t->random, t->shape_count), coloring);
        memset(t->d_color, 0, 3 * batch * sizeof(float));
        memset(t->d_code, 0, t->size * sizeof(float));
        loss += (double)dist_loss_color(batch, t->color, t->target, NULL, 1.0f, t->d_color) / how->group;
        dist_loss_code(extra, t->codes + coloring * extra, how->prior, t->d_code + t->own);
        dist_field field = dist_shape_field(t->shape);
        dist_color_backward(ctx, &field, batch, t->points, t->d_color, NULL, &grads);
        t->code_adam[coloring].rate = how->code_rate * decay;
        dist_adam_step(&t->code_adam[coloring], extra, t->codes + coloring * extra, t->d_code + t->own);
    }
    t->adam.rate = how->rate * decay;
    dist_adam_step(&t->adam, count, t->weights, t->d_weights);
    dist_net_set_weights(ctx, t->net, t->weights);
    check(ctx);
    return loss;
}

/* Trains, stores with coloring i the code of shape i * shapes / colorings before its own, and writes. */
static void paint(dist_context *ctx, const settings *how)
{
    painter t;
    dist_net *decoder = dist_net_load_file(ctx, how->color);
    check(ctx);
    painter_begin(&t, ctx, how, decoder);
    double began = seconds_now(), done = 0.0, loss = 0.0, squares = 0.0;
    int step = 0;
    progress p = progress_begin("training");
    for (; done < 1.0; step++) {
        double now = painter_step(&t, ctx, how, decoder, done), keep = step < 200 ? (double)step / (step + 1) : 0.995;
        loss = keep * loss + (1.0 - keep) * now;
        done = how->minutes > 0.0 ? (seconds_now() - began) / (60.0 * how->minutes) : (step + 1.0) / how->steps;
        progress_show(&p, done, 1.0, "loss", loss);
    }
    progress_end(&p);
    for (size_t i = 0; i < t.shape_count; i++) { /* every shape once, in a coloring that is not its own by number */
        painter_draw(&t, ctx, how, decoder, i, (i * 7 + 3) % SHAPE_COLORINGS);
        for (size_t j = 0; j < 3 * (size_t)how->batch; j++)
            squares += ((double)t.color[j] - (double)t.target[j]) * ((double)t.color[j] - (double)t.target[j]);
    }
    for (size_t i = 0; i < SHAPE_COLORINGS; i++) {
        memcpy(t.code, dist_net_code(decoder, (int)(i * t.shape_count / SHAPE_COLORINGS)), t.own * sizeof(float));
        memcpy(t.code + t.own, t.codes + i * (t.size - t.own), (t.size - t.own) * sizeof(float));
        dist_net_set_code(ctx, t.net, (int)i, t.code);
    }
    make_folders(how->out);
    dist_net_save_file(ctx, t.net, how->out);
    check(ctx);
    if (how->header) write_header(ctx, t.net, "texture", how->header);
    printf("%d colorings, %.0f weights, %d steps in %.0f s: loss %.5f, %.1f dB on every shape\n", SHAPE_COLORINGS,
           (double)dist_net_weight_count(t.net), step, seconds_now() - began, loss,
           -10.0 * log10(squares / (3.0 * (double)t.shape_count * how->batch)));
    painter_end(&t);
    dist_net_destroy(decoder);
}

/* ---- evaluation
 * ------------------------------------------------------------------------------------------------------- */

static int ascending(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Where a fit starts: in the middle of its family. */
static void family_mean(const settings *how, const dist_net *net, int position, float *code)
{
    size_t n = (size_t)dist_net_code_size(net);
    memset(code, 0, n * sizeof(float));
    for (int i = 0; i < how->shapes; i++) {
        const float *stored = dist_net_code(net, position * how->shapes + i);
        for (size_t j = 0; j < n; j++) code[j] += stored[j] / (float)how->shapes;
    }
}

/* Adam on the code alone, as DeepSDF reconstructs; code holds the start. */
static void fit_code(dist_context *ctx, const settings *how, const dist_net *net, dist_shape *decoder,
                     const pool *samples, float *code)
{
    enum { FIT_BATCH = 2048 };
    size_t n = (size_t)dist_net_code_size(net);
    float *points = take_floats(5 * FIT_BATCH), *target = points + 3 * FIT_BATCH, *loss = target + FIT_BATCH;
    float *moments = take_floats(3 * n), *d_code = moments + 2 * n;
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    adam.moments = moments;
    rng r = rng_begin(how->seed);
    for (int i = 0; i < how->iterations; i++) {
        clamped_loss l = {target, loss, clamp_limit, 1.0f / FIT_BATCH};
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        grads.code = d_code;
        adam.rate = 0.01f * (float)pow(0.5, 6 * i / how->iterations);
        memset(d_code, 0, n * sizeof(float));
        dist_loss_code(n, code, how->prior, d_code);
        pool_draw(samples, &r, FIT_BATCH, points, target);
        dist_shape_set_code(decoder, code);
        dist_field field = dist_shape_field(decoder);
        dist_field_backward(ctx, &field, FIT_BATCH, points, NULL, clamped_loss_seed, &l, NULL, &grads);
        dist_adam_step(&adam, n, code, d_code);
    }
    check(ctx);
    free(points);
    free(moments);
}

/* Chamfer distances x 1000 of a shape: [0] of the decoder with this code, [1] of the true shape sampled twice, which is
   as small as it can get with this many points. Returns 0 if the decoder gives no surface. */
static int measure(dist_context *ctx, const settings *how, dist_shape *decoder, const float *code, int family,
                   unsigned index, double result[2])
{
    size_t n = (size_t)how->samples;
    float *points = take_floats(9 * n);
    shape s;
    shape_make(&s, family, index);
    dist_field truth = shape_field(&s);
    dist_shape_set_code(decoder, code);
    dist_field field = dist_shape_field(decoder);
    surface_points(ctx, &truth, how->resolution, 1, n, points);
    surface_points(ctx, &truth, how->resolution, 2, n, points + 3 * n);
    int found = surface_points(ctx, &field, how->resolution, 3, n, points + 6 * n);
    result[0] = result[1] = 0.0;
    if (found) dist_chamfer(ctx, n, points + 6 * n, n, points, &result[0], NULL);
    dist_chamfer(ctx, n, points + 3 * n, n, points, &result[1], NULL);
    check(ctx);
    result[0] *= 1000.0;
    result[1] *= 1000.0;
    free(points);
    return found;
}

/* One line of the table. */
static void evaluate_family(dist_context *ctx, const settings *how, const dist_net *net, dist_shape *decoder,
                            int position, int held_out, progress *p, double *done, double total)
{
    int family = how->families[position];
    int count = held_out ? how->held_out : how->count;
    double *all = (double *)take((size_t)count, sizeof *all);
    float *code = take_floats((size_t)dist_net_code_size(net));
    double sum = 0.0, floor_sum = 0.0;
    int found = 0;
    for (int i = 0; i < count; i++) {
        unsigned index = held_out ? (unsigned)(SHAPE_HELD_OUT + i) : (unsigned)(i * (how->shapes / count));
        double result[2];
        if (held_out) {
            pool samples = pool_make(ctx, family, index, (size_t)how->pool);
            family_mean(how, net, position, code);
            fit_code(ctx, how, net, decoder, &samples, code);
            pool_free(&samples);
        } else {
            memcpy(code, dist_net_code(net, position * how->shapes + (int)index),
                   (size_t)dist_net_code_size(net) * sizeof(float));
        }
        if (measure(ctx, how, decoder, code, family, index, result)) {
            sum += result[0];
            all[found++] = result[0];
        }
        floor_sum += result[1] / count;
        progress_show(p, ++*done, total, NULL, 0);
    }
    qsort(all, (size_t)found, sizeof *all, ascending);
    double median = found ? 0.5 * (all[found / 2] + all[(found - 1) / 2]) : 0.0;
    printf("%s,%s,%d,%d,", shape_family_name(family), held_out ? "held-out" : "training", count, count - found);
    if (found) { printf("%.3f,%.3f,%.3f,%.3f\n", sum / found, median, all[found - 1], floor_sum); }
    if (!found) { printf(",,,%.3f\n", floor_sum); } /* no surface was found, which is no distance of 0 */
    free(all);
    free(code);
}

static void evaluate(dist_context *ctx, settings *how, const dist_net *net)
{
    int codes = dist_net_code_count(net);
    if (dist_net_code_size(net) == 0 || codes < how->family_count)
        fail("the model has no codes for %d families", how->family_count);
    how->shapes = codes / how->family_count;
    how->count = how->count < how->shapes ? how->count : how->shapes;
    dist_shape *decoder = dist_shape_create(ctx, net, NULL);
    check(ctx);
    double done = 0.0, total = (double)how->family_count * (how->count + how->held_out);
    progress p = progress_begin("measuring");
    puts("family,set,shapes,empty,chamfer_mean,chamfer_median,chamfer_worst,chamfer_of_truth");
    for (int held_out = 0; held_out < 2; held_out++) {
        if ((held_out ? how->held_out : how->count) == 0) continue;
        for (int i = 0; i < how->family_count; i++) {
            evaluate_family(ctx, how, net, decoder, i, held_out, &p, &done, total);
            fflush(stdout);
        }
    }
    progress_end(&p);
    dist_shape_destroy(decoder);
}

/* ---- program
 * ---------------------------------------------------------------------------------------------------------- */

static void parse_families(options *o, settings *how)
{
    const char *text = option_text(o);
    how->family_count = 0;
    for (; text; text = *text ? text + 1 : NULL) {
        size_t length = strcspn(text, ",");
        int family = 0;
        while (family < SHAPE_FAMILIES &&
               (strlen(shape_family_name(family)) != length || strncmp(shape_family_name(family), text, length) != 0))
            family++;
        if (family == SHAPE_FAMILIES || how->family_count == SHAPE_FAMILIES) {
            fail("%s needs a list of sofas, planes, tables, cars, got \"%s\"", o->name, text);
        }
        for (int i = 0; i < how->family_count; i++)
            if (how->families[i] == family) fail("%s names %s twice", o->name, shape_family_name(family));
        how->families[how->family_count++] = family;
        text += length;
    }
}

static int parse_training(options *o, settings *how)
{
    if (option_is(o, "--shapes")) how->shapes = option_int(o, 1, SHAPE_HELD_OUT);
    else if (option_is(o, "--layers")) how->layers = option_int(o, 1, 31);
    else if (option_is(o, "--width")) how->width = option_int(o, 1, 4096);
    else if (option_is(o, "--code")) how->code = option_int(o, 1, 1024);
    else if (option_is(o, "--steps")) how->steps = option_int(o, 1, 100000000);
    else if (option_is(o, "--epochs")) how->epochs = option_int(o, 1, 100000000);
    else if (option_is(o, "--minutes")) how->minutes = option_number(o, 0.001, 100000.0);
    else if (option_is(o, "--group")) how->group = option_int(o, 1, 100000);
    else if (option_is(o, "--batch")) how->batch = option_int(o, 1, 1000000);
    else if (option_is(o, "--rate")) how->rate = (float)option_number(o, 1e-9, 1.0);
    else if (option_is(o, "--code-rate")) how->code_rate = (float)option_number(o, 1e-9, 1.0);
    else if (option_is(o, "--eikonal")) how->eikonal = (float)option_number(o, 0.0, 1e6);
    else if (option_is(o, "--resume")) how->resume = option_text(o);
    else if (option_is(o, "--out")) how->out = option_text(o);
    else if (option_is(o, "--header")) how->header = option_text(o);
    else if (option_is(o, "--color")) how->color = option_text(o);
    else return 0;
    return 1;
}

static settings parse(int argc, char **argv)
{
    settings how;
    memset(&how, 0, sizeof how);
    for (int i = 0; i < SHAPE_FAMILIES; i++) how.families[how.family_count++] = i;
    how.shapes = 64;
    how.batch = 256;
    how.rate = 3e-3f;
    how.code_rate = 1.5e-2f;
    how.prior = 1e-4f;
    how.seed = 1;
    how.count = 16;
    how.held_out = -1;
    how.samples = 30000;
    how.resolution = 128;
    how.iterations = 400;
    options o = options_begin(argc, argv, usage);
    while (option_next(&o)) {
        if (parse_training(&o, &how)) continue;
        if (option_is(&o, "--families")) parse_families(&o, &how);
        else if (option_is(&o, "--pool")) how.pool = option_int(&o, 100, 10000000);
        else if (option_is(&o, "--prior")) how.prior = (float)option_number(&o, 0.0, 1000.0);
        else if (option_is(&o, "--seed")) how.seed = (unsigned)option_int(&o, 0, 2147483647);
        else if (option_is(&o, "--threads")) how.threads = option_int(&o, 1, 4096);
        else if (option_is(&o, "--evaluate")) how.evaluate = option_text(&o);
        else if (option_is(&o, "--count")) how.count = option_int(&o, 0, 100000);
        else if (option_is(&o, "--held-out")) how.held_out = option_int(&o, 0, 100000);
        else if (option_is(&o, "--samples")) how.samples = option_int(&o, 100, 10000000);
        else if (option_is(&o, "--resolution")) how.resolution = option_int(&o, 2, 1024);
        else if (option_is(&o, "--iterations")) how.iterations = option_int(&o, 1, 1000000);
        else option_unknown(&o);
    }
    int trained = how.layers || how.width || how.code;
    int lengths = (how.steps > 0) + (how.epochs > 0) + (how.minutes > 0);
    option_belongs(how.resume && trained, "--layers, --width and --code", "are what the model of --resume has");
    option_belongs(lengths > 1, "--steps, --epochs and --minutes", "are three ways to say how long; give one");
    option_belongs(how.evaluate && (trained || lengths || how.resume || how.header || how.color),
                   "--layers, --width, --code, --steps, --epochs, --minutes, --resume, --header and --color",
                   "are for training, not for --evaluate");
    if (!how.steps) how.steps = 20000;
    if (!how.layers) how.layers = how.color ? 3 : 5;
    if (!how.width) how.width = how.color ? 64 : 128;
    if (!how.code) how.code = how.color ? 8 : 32;
    if (!how.group) how.group = how.color ? 16 : 64;
    if (!how.pool) how.pool = how.color ? 2000 : 24000;
    if (!how.evaluate && !how.out) fail("--out FILE.safetensors is missing; --help lists the options");
    if (how.evaluate && how.out) fail("--evaluate measures a model, --out trains one: choose one of them");
    if (how.out) check_path(how.out);
    if (how.header) check_path(how.header);
    return how;
}

int main(int argc, char **argv)
{
    settings how = parse(argc, argv);
    dist_context_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.workers = how.threads;
    dist_context *ctx = dist_context_create(&desc);
    check(ctx);
    if (how.evaluate) {
        if (how.held_out < 0) how.held_out = 16;
        dist_net *net = dist_net_load_file(ctx, how.evaluate);
        check(ctx);
        evaluate(ctx, &how, net);
        dist_net_destroy(net);
    } else if (how.color) {
        paint(ctx, &how);
    } else {
        trainer t;
        train(ctx, &how, &t);
        make_folders(how.out);
        dist_net_save_file(ctx, t.net, how.out);
        check(ctx);
        if (how.header) write_header(ctx, t.net, "model", how.header);
        if (how.held_out > 0) evaluate(ctx, &how, t.net);
        trainer_end(&t);
    }
    dist_context_destroy(ctx);
    return 0;
}
