/* SPDX-License-Identifier: MIT-0
   test_color.c - textures and color channels: values, and adjoints against central differences of a model in double */
#include "test.h"

#include "model.h"

enum { SIZE = 20, PIXELS = SIZE * SIZE, POINTS = 60, MOST = 4096 };

/* A ball-like geometry and what colors it: a texture of its own code, or three more channels of the same net. In
   double: numbers[] = rotation vector, translation, lens, placement, code, color code, the geometry's weights, the
   texture's. */
typedef struct scene {
    const char *name;
    model shape, texture; /* texture.layers = 0: the channels are the geometry's */
    int code, color_code, weights, color_weights, count;
    double numbers[MOST];
    dist_camera camera;
    dist_context *ctx;
    dist_net *net[2];
    dist_shape *painted;
    dist_field field;
    float analytic[7];  /* a sphere's code, then a color code */
    dist_scene *placed; /* the shape where the placement says, and once more, out of sight; NULL: it is where it is */
} scene;

/* Places in numbers[]: of a placement log-scale, w of exp([w]x) R, translation. */
enum { TURN, MOVE = 3, LENS = 6, PLACE = 10, CODES = 17 };

static const double place_scale = 1.1, place_turn[9] = {0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1};

/* exp(-[w]x) a. */
static void turn_back(const double w[3], const double a[3], double b[3])
{
    double angle = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
    double sine = angle > 0.0 ? sin(angle) / angle : 1.0, c = angle > 0.0 ? (1.0 - cos(angle)) / (angle * angle) : 0.5;
    double x[3] = {a[1] * w[2] - a[2] * w[1], a[2] * w[0] - a[0] * w[2], a[0] * w[1] - a[1] * w[0]};
    double y[3] = {x[1] * w[2] - x[2] * w[1], x[2] * w[0] - x[0] * w[2], x[0] * w[1] - x[1] * w[0]};
    for (int i = 0; i < 3; i++) b[i] = a[i] + sine * x[i] + c * y[i];
}

/* q = R^T exp(-[w]x) (p - t) / (s exp(log-scale)) */
static void to_local(const scene *s, const double p[3], double q[3])
{
    double x[3], turned[3], scale = place_scale * exp(s->numbers[PLACE]);
    memcpy(q, p, 3 * sizeof(double));
    if (!s->placed) return;
    for (int i = 0; i < 3; i++) x[i] = (p[i] - s->numbers[PLACE + 4 + i]) / scale;
    turn_back(s->numbers + PLACE + 1, x, turned);
    for (int i = 0; i < 3; i++) {
        q[i] = 0.0;
        for (int k = 0; k < 3; k++) q[i] += place_turn[3 * k + i] * turned[k];
    }
}

static const double *numbers_of_weights(const scene *s) { return s->numbers + CODES + s->code + s->color_code; }

static double distance_at(const scene *s, const double p[3])
{
    double q[3], square = 0.0;
    const double *c = s->numbers + CODES;
    to_local(s, p, q);
    for (int i = 0; i < 3; i++) square += (q[i] - c[i]) * (q[i] - c[i]);
    if (!s->net[0]) return sqrt(square) - c[3];
    return model_eval(&s->shape, numbers_of_weights(s), s->numbers + CODES, q);
}

static void color_at(const scene *s, const double p[3], double color[3], double *closest)
{
    const model *m = s->texture.layers ? &s->texture : &s->shape;
    const double *weights = numbers_of_weights(s) + (s->texture.layers ? s->weights : 0);
    double channels[8], q[3];
    to_local(s, p, q);
    if (closest) *closest = 1e300;
    for (int i = 0; i < 3 && !s->net[0]; i++)
        color[i] = 0.5 + 0.3 * sin(3.0 * q[(i + 1) % 3] + s->numbers[CODES + 4 + i]) + 0.1 * s->numbers[CODES + i];
    if (!s->net[0]) return;
    model_channels(m, weights, s->numbers + CODES, q, channels, NULL, closest);
    memcpy(color, channels + (m->sdf_channel == 0), 3 * sizeof(double));
}

typedef struct pair {
    model_desc shape, texture;
} pair;

static const pair pairs[] = {
    {{.name = "sigmoid texture with a code", .code_size = 2, .width = 16, .activation = DIST_ACTIVATION_TANH},
     {.code_size = 5, .channels = "r,g,b", .output = MODEL_SIGMOID, .activation = DIST_ACTIVATION_SOFTPLUS,
      .first_scale = 3.0}},
    {{.name = "tanh texture, point first, skips", .code_size = 3, .activation = DIST_ACTIVATION_SOFTPLUS,
      .first_scale = 4.0},
     {.code_size = 5, .channels = "r,g,b", .skip = 4, .point_first = 1, .skip_input_first = 1, .skip_scale = 0.7,
      .activation = DIST_ACTIVATION_SINE, .first_scale = 3.0, .scale = 1.5}},
    {{.name = "the shape's code alone, skip into the last layer", .code_size = 2, .activation = DIST_ACTIVATION_SINE,
      .first_scale = 4.0, .scale = 1.5, .output = MODEL_NONE},
     {.code_size = 2, .channels = "r,g,b", .skip = 8, .output = MODEL_SIGMOID, .activation = DIST_ACTIVATION_ELU}},
    {{.name = "no code, relu texture", .width = 16},
     {.code_size = 3, .channels = "r,g,b", .width = 14, .output = MODEL_SIGMOID, .normed = 1, .norm_epsilon = 0.05}},
    {{.name = "channels of the same net", .code_size = 3, .channels = "sdf,r,g,b", .output = MODEL_NONE,
      .activation = DIST_ACTIVATION_SOFTPLUS, .first_scale = 4.0, .skip = 4}, {.name = NULL}},
    {{.name = "channels before the distance", .code_size = 2, .channels = "r,g,b,sdf", .skip = 8,
      .activation = DIST_ACTIVATION_TANH, .fourier = 1, .levels = 1, .base = 1.0}, {.name = NULL}},
    {{.name = "relu channels", .code_size = 2, .channels = "sdf,r,g,b", .width = 16}, {.name = NULL}},
};

/* As many, and an analytic sphere with c_i = 0.5 + 0.3 sin(3 p_(i+1) + z_i) + 0.1 center_i, by callbacks of our own. */
enum { PAIRS = sizeof pairs / sizeof pairs[0] + 1 };

static void own_color(void *user, int worker, size_t n, const float *points, float *color)
{
    const float *c = (const float *)user;
    (void)worker;
    for (size_t i = 0; i < 3 * n; i++)
        color[i] = 0.5f + 0.3f * sinf(3.0f * points[i / 3 * 3 + (i + 1) % 3] + c[4 + i % 3]) + 0.1f * c[i % 3];
}

static void own_adjoint(void *user, int worker, size_t n, const float *points, const float *d_color, float *d_points,
                        double *d_code, double *d_color_code)
{
    const float *c = (const float *)user;
    (void)worker;
    for (size_t i = 0; i < 3 * n; i++) {
        size_t at = i / 3 * 3 + (i + 1) % 3;
        float slope = 0.3f * d_color[i] * cosf(3.0f * points[at] + c[4 + i % 3]);
        if (d_points) d_points[at] += 3.0f * slope;
        if (d_code) d_code[i % 3] += 0.1 * (double)d_color[i];
        if (d_color_code) d_color_code[i % 3] += (double)slope;
    }
}

static void scene_look(scene *s)
{
    float eye[3] = {1.2f, 0.9f, 1.8f}, at[3] = {0.03f, -0.02f, 0.01f}, up[3] = {0.1f, 1, 0};
    s->camera = dist_camera_look_at(SIZE, SIZE, 0.9f, eye, at, up);
    for (int i = 0; i < 3; i++) s->numbers[MOVE + i] = (double)s->camera.translation[i];
    const float lens[4] = {s->camera.fx, s->camera.fy, s->camera.cx, s->camera.cy};
    for (int i = 0; i < 4; i++) s->numbers[LENS + i] = (double)lens[i];
}

static void scene_analytic(scene *s)
{
    static const float code[7] = {0.1f, -0.05f, 0.05f, 0.55f, 0.3f, -0.4f, 0.2f};
    s->name = "analytic sphere";
    s->code = 4;
    s->color_code = 3;
    memcpy(s->analytic, code, sizeof code);
    for (int i = 0; i < 7; i++) s->numbers[CODES + i] = (double)code[i];
    s->field = dist_field_sphere(s->analytic);
    s->field.color_fn = own_color;
    s->field.color_adjoint_fn = own_adjoint;
    s->field.color_code_size = 3;
}

static void scene_open(scene *s, int k, int workers)
{
    static test_scheduler scheduler;
    dist_context_desc desc = test_context_desc();
    test_random random = test_random_seed(500u + (unsigned)k);
    float code[2 * MODEL_CODE];
    memset(s, 0, sizeof *s);
    scheduler.workers = desc.workers = workers;
    desc.scheduler = test_scheduler_hook(&scheduler);
    s->ctx = dist_context_create(&desc);
    scene_look(s);
    if (k == PAIRS - 1) {
        scene_analytic(s);
        return;
    }
    const pair *d = &pairs[k];
    s->name = d->shape.name;
    s->shape = model_make(&d->shape, 70u + (unsigned)k);
    s->code = d->shape.code_size;
    test_random_fill(&random, 2 * MODEL_CODE, code, -0.5f, 0.5f);
    for (int i = 0; i < MODEL_CODE; i++) s->numbers[CODES + i] = (double)code[i];
    model_fit_ball(&s->shape, s->numbers + CODES, 0.6);
    s->net[0] = model_load(s->ctx, &s->shape);
    s->painted = dist_shape_create(s->ctx, s->net[0], code);
    s->weights = (int)s->shape.count;
    if (d->texture.channels) {
        s->texture = model_make(&d->texture, 90u + (unsigned)k);
        s->net[1] = model_load(s->ctx, &s->texture);
        s->color_code = d->texture.code_size - s->code;
        s->color_weights = (int)s->texture.count;
        CHECK_STATUS(DIST_OK, dist_shape_set_texture(s->painted, s->net[1], code + s->code), s->ctx);
    }
    s->count = CODES + s->code + s->color_code + s->weights + s->color_weights;
    if (s->count > MOST) exit(1);
    double *weights = s->numbers + CODES + s->code + s->color_code;
    memcpy(weights, s->shape.params, s->shape.count * sizeof(double));
    if (s->texture.layers) memcpy(weights + s->weights, s->texture.params, s->texture.count * sizeof(double));
    s->field = dist_shape_field(s->painted);
    MODEL_CHECK(s->field.color_adjoint_fn != NULL, s->name, dist_context_message(s->ctx), 0, 0);
    CHECK_EQUAL(s->color_code, s->field.color_code_size);
    CHECK_EQUAL(s->color_weights, s->field.color_weight_count);
}

/* Turns the scene into one with its shape placed. */
static void scene_place(scene *s)
{
    static const float move[3] = {0.125f, -0.0625f, 0.1875f};
    dist_instance instances[2];
    memset(instances, 0, sizeof instances);
    instances[0].field = instances[1].field = &s->field;
    instances[1].placement.translation[0] = -30.0f;
    instances[0].placement.scale = (float)place_scale;
    for (int i = 0; i < 9; i++) instances[0].placement.rotation[i] = (float)place_turn[i];
    memcpy(instances[0].placement.translation, move, sizeof move);
    for (int i = 0; i < 3; i++) s->numbers[PLACE + 4 + i] = (double)move[i];
    s->placed = dist_scene_create(s->ctx, 2, instances);
    s->field = dist_scene_field(s->placed);
    MODEL_CHECK(s->field.color_adjoint_fn != NULL, s->name, dist_context_message(s->ctx), 0, 0);
    CHECK_EQUAL(2 * s->color_code, s->field.color_code_size);
    CHECK_EQUAL(2 * (s->code + 7), s->field.code_size);
}

static void scene_close(scene *s)
{
    dist_scene_destroy(s->placed);
    dist_shape_destroy(s->painted);
    dist_net_destroy(s->net[0]);
    dist_net_destroy(s->net[1]);
    dist_context_destroy(s->ctx);
    if (s->shape.layers) model_free(&s->shape);
    if (s->texture.layers) model_free(&s->texture);
}

/* Gradients in the order of numbers[]. */
static dist_gradients gradients_of(const scene *s, float *g)
{
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    memset(g, 0, MOST * sizeof(float));
    grads.rotation = g + TURN;
    grads.translation = g + MOVE;
    grads.focal = g + LENS;
    grads.principal = g + LENS + 2;
    if (s->code) grads.code = g + CODES;
    if (s->color_code) grads.color_code = g + CODES + s->code;
    if (s->weights) grads.weights = g + CODES + s->code + s->color_code;
    if (s->color_weights) grads.color_weights = grads.weights + s->weights;
    return grads;
}

/* Central differences of loss_fn against g for n numbers from `first`, relative to the largest of them; of many, 24. */
static void compare(scene *s, const char *what, int first, int n, const float *g,
                    double (*loss_fn)(const scene *, const void *), const void *job, double tolerance)
{
    const double h = 1e-6;
    double worst = 0.0, largest = 0.0;
    int step = n > 24 ? n / 24 : 1;
    for (int i = first; i < first + n; i += step) {
        double old = s->numbers[i];
        s->numbers[i] = old + h;
        double expected = loss_fn(s, job);
        s->numbers[i] = old - h;
        expected = (expected - loss_fn(s, job)) / (2.0 * h);
        s->numbers[i] = old;
        worst = fmax(worst, fabs(expected - (double)g[i]));
        largest = fmax(largest, fabs(expected));
    }
    if (n == 0) return;
    MODEL_CHECK(largest > 1e-3, s->name, what, 1e-3, largest); /* there is something to compare */
    MODEL_CHECK(worst <= tolerance * largest, s->name, what, tolerance * largest, worst);
    if (test_state.verbose) printf("    %s, %s: %.1e of %.2g\n", s->name, what, worst, largest);
}

/* ---- points ------------------------------------------------------------------------------------------------------ */

typedef struct point_job {
    double points[3 * POINTS], d_color[3 * POINTS];
} point_job;

static double point_loss(const scene *s, const void *user)
{
    const point_job *job = (const point_job *)user;
    double sum = 0.0, color[3];
    for (int i = 0; i < POINTS; i++) {
        color_at(s, job->points + 3 * i, color, NULL);
        for (int k = 0; k < 3; k++) sum += job->d_color[3 * i + k] * color[k];
    }
    return sum;
}

TEST(color_backward_at_points_matches_differences)
{
    static float g[MOST];
    for (int k = 0; k < PAIRS; k++) {
        scene s;
        point_job job;
        float points[3 * POINTS], d_color[3 * POINTS], color[3 * POINTS], d_points[3 * POINTS];
        test_random random = test_random_seed(3);
        scene_open(&s, k, 1);
        for (int i = 0; i < POINTS;) {
            double closest, c[3];
            test_random_fill(&random, 3, points + 3 * i, -0.8f, 0.8f);
            for (int j = 3 * i; j < 3 * i + 3; j++) {
                job.points[j] = (double)points[j];
                d_color[j] = test_random_float(&random, -0.3f, 1.0f);
                job.d_color[j] = (double)d_color[j];
            }
            color_at(&s, job.points + 3 * i, c, &closest);
            i += closest > 1e-4; /* a kink of a ReLU has no derivative */
        }
        CHECK_STATUS(DIST_OK, dist_color_eval(s.ctx, &s.field, POINTS, points, color), s.ctx);
        for (int i = 0; i < POINTS; i++) {
            double c[3];
            color_at(&s, job.points + 3 * i, c, NULL);
            for (int j = 0; j < 3; j++) CHECK_NEAR(c[j], color[3 * i + j], 2e-5);
        }
        dist_gradients grads = gradients_of(&s, g);
        grads.rotation = grads.translation = grads.focal = grads.principal = NULL;
        if (s.color_weights) grads.weights = NULL;
        memset(d_points, 0, sizeof d_points);
        CHECK_STATUS(DIST_OK, dist_color_backward(s.ctx, &s.field, POINTS, points, d_color, d_points, &grads), s.ctx);
        int at = CODES + s.code + s.color_code;
        compare(&s, "code", CODES, s.code, g, point_loss, &job, 2e-4);
        compare(&s, "color code", CODES + s.code, s.color_code, g, point_loss, &job, 2e-4);
        if (s.color_weights)
            compare(&s, "texture's weights", at + s.weights, s.color_weights, g, point_loss, &job, 2e-4);
        else compare(&s, "weights", at, s.weights, g, point_loss, &job, 2e-4);
        double worst = 0.0, largest = 0.0;
        for (int i = 0; i < 3 * POINTS; i++) {
            double old = job.points[i], ahead, h = 1e-6;
            job.points[i] = old + h;
            ahead = point_loss(&s, &job);
            job.points[i] = old - h;
            ahead = (ahead - point_loss(&s, &job)) / (2.0 * h);
            job.points[i] = old;
            worst = fmax(worst, fabs(ahead - (double)d_points[i]));
            largest = fmax(largest, fabs(ahead));
        }
        MODEL_CHECK(largest > 0.01 && worst <= 2e-4 * largest, s.name, "points", 2e-4 * largest, worst);
        scene_close(&s);
    }
}

/* ---- pictures ---------------------------------------------------------------------------------------------------- */

typedef struct image_job {
    double t[PIXELS], weight[3 * PIXELS];
} image_job;

/* exp(-[w]x) a, then R^T. */
static void to_world(const scene *s, const double a[3], double b[3])
{
    double turned[3];
    turn_back(s->numbers + TURN, a, turned);
    for (int i = 0; i < 3; i++) {
        b[i] = 0.0;
        for (int k = 0; k < 3; k++) b[i] += (double)s->camera.rotation[3 * k + i] * turned[k];
    }
}

/* The hit of a pixel's ray near distance t by the secant rule: 0, or its distance; p its place. */
static double hit_near(const scene *s, int pixel, double t, double p[3], double direction[3])
{
    const double *lens = s->numbers + LENS;
    double d[3] = {(pixel % SIZE - lens[2]) / lens[0], (pixel / SIZE - lens[3]) / lens[1], 1.0};
    double length = sqrt(d[0] * d[0] + d[1] * d[1] + 1.0), minus[3], o[3], before = t - 1e-3, f_before = 0.0;
    for (int i = 0; i < 3; i++) {
        d[i] /= length;
        minus[i] = -s->numbers[MOVE + i];
    }
    to_world(s, d, direction);
    to_world(s, minus, o);
    for (int step = -1; step < 12; step++) {
        double at = step < 0 ? before : t;
        for (int i = 0; i < 3; i++) p[i] = o[i] + at * direction[i];
        double f = distance_at(s, p);
        if (step < 0) {
            f_before = f;
            continue;
        }
        if (fabs(f) < 1e-16 || fabs(f - f_before) < 1e-300) break;
        double next = t - f * (t - before) / (f - f_before);
        before = t;
        f_before = f;
        t = next;
    }
    return t;
}

static double image_loss(const scene *s, const void *user)
{
    const image_job *job = (const image_job *)user;
    double sum = 0.0, p[3], v[3], color[3];
    for (int i = 0; i < PIXELS; i++) {
        if (!(job->t[i] > 0.0)) continue;
        hit_near(s, i, job->t[i], p, v);
        color_at(s, p, color, NULL);
        for (int k = 0; k < 3; k++) sum += job->weight[3 * i + k] * color[k];
    }
    return sum;
}

typedef struct pictures {
    float distance[PIXELS], color[3 * PIXELS], d_color[3 * PIXELS];
    unsigned char mask[PIXELS];
    dist_images out, d_out;
    dist_stats stats;
} pictures;

static dist_tape *pictures_take(pictures *a, scene *s)
{
    dist_render_desc how;
    memset(a, 0, sizeof *a);
    memset(&how, 0, sizeof how);
    how.background_color[1] = 0.5f;
    a->out.distance = a->distance;
    a->out.color = a->color;
    a->out.mask = a->mask;
    a->out.stats = &a->stats;
    a->d_out.color = a->d_color;
    dist_tape *tape = dist_tape_create(s->ctx, &s->camera, &how);
    CHECK_STATUS(DIST_OK, dist_render(s->ctx, &s->field, &s->camera, &how, &a->out, tape), s->ctx);
    return tape;
}

/* Fills job and the upstream gradient with the pixels to compare; the others' is 0. */
static void pixels_choose(const scene *s, pictures *a, image_job *job)
{
    int used = 0, excluded = 0;
    test_random random = test_random_seed(8);
    memset(job, 0, sizeof *job);
    for (int i = 0; i < PIXELS; i++) {
        double p[3], q[3], v[3], color[3], closest[2], slope = 0.0, size = 0.0;
        if (!a->mask[i]) {
            CHECK_NEAR(0.5, a->color[3 * i + 1], 0);
            a->d_color[3 * i] = 1.0f; /* a miss has no color to pull on */
            continue;
        }
        double t = hit_near(s, i, (double)a->distance[i], p, v);
        to_local(s, p, q);
        closest[0] = 1e300;
        if (s->net[0]) model_channels(&s->shape, numbers_of_weights(s), s->numbers + CODES, q, NULL, NULL, &closest[0]);
        color_at(s, p, color, &closest[1]);
        for (int j = 0; j < 3; j++) {
            double moved[3] = {p[0], p[1], p[2]}, d;
            moved[j] += 1e-6;
            d = distance_at(s, moved) / 1e-6;
            slope += d * v[j];
            size += d * d;
        }
        int bad = closest[0] < 5e-4 || closest[1] < 5e-4 || slope > -0.15 * sqrt(size) ||
                  fabs(t - (double)a->distance[i]) > 1e-3;
        used += !bad;
        excluded += bad;
        if (bad) continue;
        job->t[i] = t;
        for (int j = 0; j < 3; j++) {
            CHECK_NEAR(color[j], a->color[3 * i + j], 1e-3);
            a->d_color[3 * i + j] = test_random_float(&random, -0.2f, 1.0f);
            job->weight[3 * i + j] = (double)a->d_color[3 * i + j];
        }
    }
    MODEL_CHECK(used >= 50 && 10 * excluded <= used + excluded, s->name, "pixels excluded", used, excluded);
}

TEST(color_backward_of_pictures_matches_differences)
{
    static float g[MOST];
    static pictures a;
    static image_job job;
    for (int k = 0; k < PAIRS; k++) {
        scene s;
        scene_open(&s, k, 1);
        dist_tape *tape = pictures_take(&a, &s);
        pixels_choose(&s, &a, &job);
        dist_gradients grads = gradients_of(&s, g);
        CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, tape, &a.d_out, &grads), s.ctx);
        int at = CODES + s.code + s.color_code;
        compare(&s, "rotation", TURN, 3, g, image_loss, &job, 5e-4);
        compare(&s, "translation", MOVE, 3, g, image_loss, &job, 5e-4);
        compare(&s, "focal lengths", LENS, 2, g, image_loss, &job, 5e-4);
        compare(&s, "principal point", LENS + 2, 2, g, image_loss, &job, 5e-4);
        compare(&s, "code", CODES, s.code, g, image_loss, &job, 5e-4);
        compare(&s, "color code", CODES + s.code, s.color_code, g, image_loss, &job, 5e-4);
        compare(&s, "weights", at, s.weights, g, image_loss, &job, 5e-4);
        compare(&s, "texture's weights", at + s.weights, s.color_weights, g, image_loss, &job, 5e-4);
        dist_tape_destroy(tape);
        scene_close(&s);
    }
}

/* DIST_GRADIENT_NORMAL weights what depth pulls on, nothing of what colors and normals do. */
TEST(color_backward_is_the_same_where_depth_is_weighted_by_the_normal)
{
    static float g[2][MOST], normal[3 * PIXELS], d_normal[3 * PIXELS];
    static pictures a;
    static image_job job;
    scene s;
    scene_open(&s, 0, 1);
    for (int weighted = 0; weighted < 2; weighted++) {
        dist_render_desc how;
        memset(&how, 0, sizeof how);
        how.background_color[1] = 0.5f;
        how.gradient = weighted ? DIST_GRADIENT_NORMAL : DIST_GRADIENT_IMPLICIT;
        dist_tape_destroy(pictures_take(&a, &s));
        pixels_choose(&s, &a, &job);
        a.out.normal = normal;
        a.d_out.normal = d_normal;
        for (int i = 0; i < 3 * PIXELS; i++) d_normal[i] = 0.01f * (float)(i % 7 - 3);
        dist_tape *tape = dist_tape_create(s.ctx, &s.camera, &how);
        CHECK_STATUS(DIST_OK, dist_render(s.ctx, &s.field, &s.camera, &how, &a.out, tape), s.ctx);
        dist_gradients grads = gradients_of(&s, g[weighted]);
        CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, tape, &a.d_out, &grads), s.ctx);
        dist_tape_destroy(tape);
    }
    CHECK(g[0][MOVE] < 0.0f || g[0][MOVE] > 0.0f);
    CHECK_BYTES(sizeof g[0], g[0], g[1]);
    scene_close(&s);
}

TEST(color_backward_of_placed_shapes_matches_differences)
{
    static float g[MOST];
    static pictures a;
    static image_job job;
    for (int k = 0; k < PAIRS; k++) {
        scene s;
        float both[2 * (MODEL_CODE + 7)], colors[2 * MODEL_CODE];
        memset(both, 0, sizeof both);
        memset(colors, 0, sizeof colors);
        scene_open(&s, k, 1);
        scene_place(&s);
        dist_tape *tape = pictures_take(&a, &s);
        pixels_choose(&s, &a, &job);
        dist_gradients grads = gradients_of(&s, g);
        grads.code = both;
        if (s.color_code) grads.color_code = colors;
        grads.weights = grads.color_weights = NULL;
        CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, tape, &a.d_out, &grads), s.ctx);
        memcpy(g + PLACE, both + s.code, 7 * sizeof(float));
        memcpy(g + CODES, both, (size_t)s.code * sizeof(float));
        memcpy(g + CODES + s.code, colors, (size_t)s.color_code * sizeof(float));
        for (int i = 0; i < s.code + 7; i++) CHECK_NEAR(0, both[s.code + 7 + i], 0); /* out of sight */
        for (int i = 0; i < s.color_code; i++) CHECK_NEAR(0, colors[s.color_code + i], 0);
        compare(&s, "translation of the camera", MOVE, 3, g, image_loss, &job, 5e-4);
        compare(&s, "scale", PLACE, 1, g, image_loss, &job, 5e-4);
        compare(&s, "placed rotation", PLACE + 1, 3, g, image_loss, &job, 5e-4);
        compare(&s, "placed translation", PLACE + 4, 3, g, image_loss, &job, 5e-4);
        compare(&s, "code, placed", CODES, s.code, g, image_loss, &job, 5e-4);
        compare(&s, "color code, placed", CODES + s.code, s.color_code, g, image_loss, &job, 5e-4);
        dist_tape_destroy(tape);
        scene_close(&s);
    }
}

/* The color's own part does not depend on how the distance's gradient is taken; and codes are found by it. */
TEST(a_color_code_is_recovered_from_one_picture_with_either_tracer)
{
    static pictures target, a;
    for (int paper = 0; paper < 2; paper++) {
        scene s;
        dist_render_desc how;
        dist_adam adam;
        dist_gradients grads;
        float code[3], wanted[3] = {0.4f, -0.6f, 0.3f}, d_code[3], moments[6] = {0, 0, 0, 0, 0, 0}, first = 0, loss = 0;
        memset(&how, 0, sizeof how);
        memset(&adam, 0, sizeof adam);
        memset(&grads, 0, sizeof grads);
        memset(code, 0, sizeof code);
        scene_open(&s, 0, 1);
        how.trace = paper ? DIST_TRACE_PAPER : DIST_TRACE_GUARDED;
        adam.moments = moments;
        adam.rate = 0.05f;
        grads.color_code = d_code;
        dist_tape *tape = dist_tape_create(s.ctx, &s.camera, &how);
        memset(&target, 0, sizeof target);
        target.out.color = target.color;
        dist_shape_set_color_code(s.painted, wanted);
        CHECK_STATUS(DIST_OK, dist_render(s.ctx, &s.field, &s.camera, &how, &target.out, NULL), s.ctx);
        memset(&a, 0, sizeof a);
        a.out.color = a.color;
        a.out.mask = a.mask;
        a.d_out.color = a.d_color;
        for (int step = 0; step < 400; step++) {
            memset(a.d_color, 0, sizeof a.d_color);
            memset(d_code, 0, sizeof d_code);
            dist_shape_set_color_code(s.painted, code);
            dist_render(s.ctx, &s.field, &s.camera, &how, &a.out, tape);
            loss = dist_loss_color(PIXELS, a.color, target.color, a.mask, 1.0f, a.d_color);
            if (step == 0) first = loss;
            adam.rate = 0.05f * (1.0f - (float)step / 400.0f);
            CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, tape, &a.d_out, &grads), s.ctx);
            dist_adam_step(&adam, 3, code, d_code);
        }
        CHECK(loss < 0.02f * first);
        CHECK_NEAR_ARRAY(3, wanted, code, 0.02);
        dist_tape_destroy(tape);
        scene_close(&s);
    }
}

TEST(color_gradients_have_the_same_bits_for_every_number_of_workers_and_whatever_else_is_wanted)
{
    static float g[3][MOST];
    static pictures a;
    for (int k = 0; k < PAIRS; k++) {
        for (int run = 0; run < 3; run++) {
            scene s;
            test_random random = test_random_seed(11);
            scene_open(&s, k, run == 1 ? 3 : 1);
            dist_tape *tape = pictures_take(&a, &s);
            test_random_fill(&random, 3 * PIXELS, a.d_color, -1.0f, 1.0f);
            dist_gradients grads = gradients_of(&s, g[run]);
            if (run == 2) { /* the color's own alone */
                if (s.color_weights) grads.code = grads.weights = NULL;
                grads.rotation = grads.translation = grads.focal = grads.principal = NULL;
            }
            CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, tape, &a.d_out, &grads), s.ctx);
            size_t own = (size_t)(CODES + s.code), bytes = sizeof(float);
            if (run == 1) CHECK_BYTES(sizeof g[0], g[0], g[1]);
            if (run == 2) {
                CHECK_BYTES((size_t)s.color_code * bytes, g[0] + own, g[2] + own);
                own += (size_t)(s.color_code + s.weights);
                CHECK_BYTES((size_t)s.color_weights * bytes, g[0] + own, g[2] + own);
            }
            dist_tape_destroy(tape);
            scene_close(&s);
        }
    }
}

TEST(color_queries_are_counted_and_none_made_where_no_color_is_asked_for)
{
    static pictures a;
    scene s;
    scene_open(&s, 0, 1);
    dist_tape_destroy(pictures_take(&a, &s));
    dist_stats colored = a.stats;
    CHECK_EQUAL(colored.hits, colored.color_queries);
    CHECK(colored.hits > 50);
    a.out.color = NULL;
    CHECK_STATUS(DIST_OK, dist_render(s.ctx, &s.field, &s.camera, NULL, &a.out, NULL), s.ctx);
    CHECK_EQUAL(0, a.stats.color_queries);
    CHECK_EQUAL(colored.queries - colored.color_queries, a.stats.queries);
    CHECK_NEAR(colored.operations - (double)colored.hits * (double)dist_net_operations(s.net[1], 1),
               a.stats.operations, 0.5);
    scene_close(&s);
}

TEST(codes_of_a_textured_shape_are_set_one_by_one)
{
    scene s, t;
    float point[3] = {0.2f, 0.3f, -0.4f}, code[8] = {0.1f, -0.2f, 0.3f, 0.4f, -0.5f}, one[3], two[3], three[3];
    scene_open(&s, 0, 1);
    dist_color_eval(s.ctx, &s.field, 1, point, one);
    CHECK_STATUS(DIST_OK, dist_shape_set_code(s.painted, code), s.ctx);
    CHECK_STATUS(DIST_OK, dist_shape_set_color_code(s.painted, code + 2), s.ctx);
    dist_color_eval(s.ctx, &s.field, 1, point, two);
    CHECK(memcmp(one, two, sizeof one) != 0);
    scene_open(&t, 0, 1); /* all at once, by the texture as a net of its own */
    dist_shape *alone = dist_shape_create(t.ctx, t.net[1], code);
    CHECK_STATUS(DIST_OK, dist_shape_eval(t.ctx, alone, 1, point, three), t.ctx);
    CHECK_BYTES(sizeof two, two, three);
    dist_shape_destroy(alone);
    CHECK_STATUS(DIST_OK, dist_shape_set_texture(s.painted, NULL, NULL), s.ctx);
    CHECK(dist_shape_field(s.painted).color_fn == NULL);
    scene_close(&s);
    scene_close(&t);
}

TEST(color_of_a_field_that_is_older_than_its_texture_is_refused)
{
    static pictures a;
    const float point[3] = {0.2f, 0.3f, -0.4f};
    scene s;
    float color[3], sdf;
    scene_open(&s, 0, 1);
    dist_instance instance;
    memset(&instance, 0, sizeof instance);
    instance.field = &s.field;
    dist_scene *all = dist_scene_create(s.ctx, 1, &instance);
    dist_field both[2] = {s.field, dist_scene_field(all)};
    dist_images out;
    memset(&out, 0, sizeof out);
    out.color = a.color;
    static float g[MOST];
    dist_gradients grads = gradients_of(&s, g);
    dist_tape *tape = pictures_take(&a, &s);
    for (int again = 0; again < 2; again++) {
        dist_status back = dist_render_backward(s.ctx, tape, &a.d_out, &grads);
        CHECK_STATUS(again ? DIST_BAD_ARGUMENT : DIST_OK, back, s.ctx);
        dist_context_clear(s.ctx);
        for (int k = 0; k < 2; k++) {
            CHECK_STATUS(DIST_OK, dist_field_eval(s.ctx, &both[k], 1, point, &sdf, NULL), s.ctx); /* always */
            dist_status status = dist_color_eval(s.ctx, &both[k], 1, point, color);
            CHECK_STATUS(again ? DIST_BAD_ARGUMENT : DIST_OK, status, s.ctx);
            if (again) CHECK(strstr(dist_context_message(s.ctx), "is older than its shape's texture") != NULL);
            dist_context_clear(s.ctx);
            status = dist_render(s.ctx, &both[k], &s.camera, NULL, &out, NULL);
            CHECK_STATUS(again ? DIST_BAD_ARGUMENT : DIST_OK, status, s.ctx);
            dist_context_clear(s.ctx);
        }
        CHECK_STATUS(DIST_OK, dist_shape_set_texture(s.painted, s.net[1], NULL), s.ctx);
    }
    s.field = dist_shape_field(s.painted);
    CHECK_STATUS(DIST_OK, dist_color_eval(s.ctx, &s.field, 1, point, color), s.ctx);
    dist_tape_destroy(tape);
    dist_scene_destroy(all);
    scene_close(&s);
}

/* A tape of another color: refused where color is asked for, alone and in a scene, and taken again once it is back. */
TEST(color_gradients_of_another_color_code_or_other_weights_are_refused)
{
    static pictures a;
    static float g[MOST];
    scene s;
    float code[8] = {0.1f, -0.2f, 0.3f, 0.4f, -0.5f};
    scene_open(&s, 0, 1);
    size_t count = dist_net_weight_count(s.net[1]);
    float *weights = (float *)malloc(2 * count * sizeof(float));
    REQUIRE(weights != NULL);
    for (size_t i = 0; i < count; i++) {
        weights[i] = dist_net_weights(s.net[1])[i];
        weights[count + i] = 1.1f * weights[i];
    }
    CHECK_STATUS(DIST_OK, dist_shape_set_color_code(s.painted, NULL), s.ctx);
    dist_instance instance;
    memset(&instance, 0, sizeof instance);
    instance.field = &s.field;
    dist_scene *all = dist_scene_create(s.ctx, 1, &instance);
    for (int k = 0; k < 2; k++) {
        if (k) s.field = dist_scene_field(all);
        dist_tape *tape = pictures_take(&a, &s);
        dist_gradients grads = gradients_of(&s, g);
        grads.weights = grads.color_weights = NULL;
        dist_images plain = a.d_out;
        plain.color = NULL;
        for (int what = 0; what < 2; what++)
            for (int on = 1; on >= 0; on--) {
                const float *of = weights + (on ? count : 0);
                if (what) CHECK_STATUS(DIST_OK, dist_net_set_weights(s.ctx, s.net[1], of), s.ctx);
                CHECK_STATUS(DIST_OK, dist_shape_set_color_code(s.painted, on && !what ? code : NULL), s.ctx);
                CHECK_STATUS(DIST_OK, dist_render_backward(s.ctx, tape, &plain, &grads), s.ctx);
                dist_status status = dist_render_backward(s.ctx, tape, &a.d_out, &grads);
                CHECK_STATUS(on ? DIST_BAD_ARGUMENT : DIST_OK, status, s.ctx);
                if (on) CHECK_TEXT("the color's code or weights are not what they were", dist_context_message(s.ctx));
                dist_context_clear(s.ctx);
            }
        dist_tape_destroy(tape);
    }
    free(weights);
    dist_scene_destroy(all);
    scene_close(&s);
}

/* red = x, whose adjoint hands on what it gets. */
static void red_color(void *user, int worker, size_t n, const float *points, float *color)
{
    (void)user, (void)worker;
    for (size_t i = 0; i < 3 * n; i++) color[i] = i % 3 ? 0.0f : points[i];
}

static void red_adjoint(void *user, int worker, size_t n, const float *points, const float *d_color, float *d_points,
                        double *d_code, double *d_color_code)
{
    (void)user, (void)worker, (void)points, (void)d_color_code;
    for (size_t i = 0; i < n; i++) {
        if (d_points) d_points[3 * i] += d_color[3 * i];
        if (d_code) d_code[0] += (double)d_color[3 * i];
    }
}

TEST(colors_of_own_fields_lose_no_gradient_to_what_is_not_finite)
{
    const float bad[3] = {NAN, INFINITY, -INFINITY};
    float ball[4] = {0, 0, 0, 0.5f};
    dist_context *ctx = test_context();
    dist_field field = dist_field_sphere(ball);
    field.color_fn = red_color;
    field.color_adjoint_fn = red_adjoint;
    for (int k = 0; k < 6; k++) { /* in the seeds, in the points */
        float points[30], d_color[30], d_points[30] = {0}, code[4] = {0};
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        grads.code = code;
        for (int i = 0; i < 30; i++) points[i] = 0.01f * (float)i, d_color[i] = 0.25f;
        (k < 3 ? d_color : points)[13] = bad[k % 3];
        CHECK_STATUS(DIST_OK, dist_color_backward(ctx, &field, 10, points, d_color, d_points, &grads), ctx);
        CHECK(code[0] == 9 * 0.25f);
        for (int i = 0; i < 30; i++) CHECK(d_points[i] == (i % 3 || i == 12 ? 0.0f : 0.25f));
    }
    dist_context_destroy(ctx);
}

TEST(memory_refused_to_a_texture_leaves_the_shape_as_it_was)
{
    model m = model_make(&pairs[0].shape, 70u), t = model_make(&pairs[0].texture, 90u);
    for (size_t at = 1;; at++) {
        test_allocator a;
        dist_context_desc desc = test_context_desc();
        float point[3] = {0.2f, 0.1f, 0.3f}, before, after;
        memset(&a, 0, sizeof a);
        desc.allocator = test_allocator_hook(&a);
        dist_context *ctx = dist_context_create(&desc);
        dist_net *net = model_load(ctx, &m), *texture = model_load(ctx, &t);
        dist_shape *shape = dist_shape_create(ctx, net, NULL);
        dist_field field = dist_shape_field(shape);
        dist_field_eval(ctx, &field, 1, point, &before, NULL);
        if (at % 2) dist_field_eval(ctx, &field, 1, NULL, &before, NULL); /* refused: the context's first failure */
        a.fail_at = a.requests + at;
        dist_status status = dist_shape_set_texture(shape, texture, NULL);
        a.fail_at = 0;
        field = dist_shape_field(shape);
        dist_field_eval(ctx, &field, 1, point, &after, NULL);
        CHECK_BYTES(sizeof before, &before, &after);
        CHECK((field.color_fn != NULL) == (status == DIST_OK));
        if (status != DIST_OK) CHECK_STATUS(DIST_OUT_OF_MEMORY, status, ctx);
        dist_shape_destroy(shape);
        dist_net_destroy(net);
        dist_net_destroy(texture);
        dist_context_destroy(ctx);
        CHECK_EQUAL(0, a.live_blocks);
        if (status == DIST_OK) {
            CHECK(at > 3);
            break;
        }
    }
    model_free(&m);
    model_free(&t);
}

TEST(a_texture_that_does_not_fit_and_gradients_that_are_not_there_are_refused)
{
    static pictures a;
    static float g[MOST];
    scene s;
    float x[3] = {0, 0, 0}, bad[3] = {0, 0, 0};
    scene_open(&s, 0, 1);
    CHECK_STATUS(DIST_UNSUPPORTED, dist_shape_set_texture(s.painted, s.net[0], NULL), s.ctx); /* no r,g,b */
    dist_shape *wrong = dist_shape_create(s.ctx, s.net[1], NULL); /* whose code is longer than the texture's */
    scene same;
    scene_open(&same, 2, 1);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_shape_set_texture(wrong, same.net[1], NULL), s.ctx);
    scene_close(&same);
    dist_shape_destroy(wrong);
    memset(bad, 0xff, sizeof bad);
    CHECK_STATUS(DIST_NOT_FINITE, dist_shape_set_texture(s.painted, s.net[1], bad), s.ctx);
    CHECK_STATUS(DIST_NOT_FINITE, dist_shape_set_color_code(s.painted, bad), s.ctx);
    CHECK_EQUAL(DIST_BAD_ARGUMENT, dist_shape_set_texture(NULL, s.net[1], NULL));
    dist_gradients grads = gradients_of(&s, g);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_color_backward(s.ctx, &s.field, 1, x, x, NULL, &grads), s.ctx); /* camera */
    grads.rotation = grads.translation = grads.focal = grads.principal = NULL;
    float *weights = grads.weights;
    grads.weights = NULL;
    dist_context_clear(s.ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_color_backward(s.ctx, &s.field, 1, x, NULL, NULL, &grads), s.ctx);
    CHECK_TEXT("dist_color_backward: d_color is NULL", dist_context_message(s.ctx));
    dist_context_clear(s.ctx);
    size_t most = (size_t)-1;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_color_backward(s.ctx, &s.field, most, x, x, NULL, &grads), s.ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_color_eval(s.ctx, &s.field, most, x, x), s.ctx);
    CHECK_STATUS(DIST_OK, dist_color_eval(s.ctx, &s.field, 0, NULL, NULL), s.ctx);
    grads.weights = weights;
    CHECK_STATUS(DIST_UNSUPPORTED, dist_color_backward(s.ctx, &s.field, 1, x, x, NULL, &grads), s.ctx); /* weights */
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_backward(s.ctx, &s.field, 1, x, x, NULL, NULL, NULL, &grads), s.ctx);
    float sphere[4] = {0, 0, 0, 0.5f};
    dist_field plain = dist_field_sphere(sphere);
    CHECK_STATUS(DIST_UNSUPPORTED, dist_color_eval(s.ctx, &plain, 1, x, x), s.ctx);
    CHECK_STATUS(DIST_UNSUPPORTED, dist_color_backward(s.ctx, &plain, 1, x, x, NULL, &grads), s.ctx);
    dist_field own = s.field; /* codes that are not there, or cannot be */
    memset(&grads, 0, sizeof grads);
    grads.code = g;
    own.code_size = 0;
    dist_context_clear(s.ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_color_backward(s.ctx, &own, 1, x, x, NULL, &grads), s.ctx);
    CHECK_TEXT("grads.code is given, but the field has no code", dist_context_message(s.ctx));
    own.code_size = -1;
    dist_context_clear(s.ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_color_eval(s.ctx, &own, 1, x, x), s.ctx);
    CHECK_TEXT("field.code_size is -1", dist_context_message(s.ctx));
    grads.code = NULL;
    grads.color_weights = g;
    dist_context_clear(s.ctx);
    CHECK_STATUS(DIST_UNSUPPORTED, dist_field_backward(s.ctx, &plain, 1, x, x, NULL, NULL, NULL, &grads), s.ctx);
    CHECK_TEXT("grads.color_weights is given, but the field has no texture", dist_context_message(s.ctx));
    grads = gradients_of(&s, g);
    s.field.color_adjoint_fn = NULL;
    dist_tape *tape = pictures_take(&a, &s);
    dist_context_clear(s.ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render_backward(s.ctx, tape, &a.d_out, &grads), s.ctx);
    CHECK_TEXT("grads.color_code is given, but the field has no color code or color_adjoint_fn",
               dist_context_message(s.ctx));
    grads.color_code = NULL;
    CHECK_STATUS(DIST_UNSUPPORTED, dist_render_backward(s.ctx, tape, &a.d_out, &grads), s.ctx);
    dist_tape_destroy(tape);
    scene_close(&s);
}

TEST(a_texture_net_is_created_saved_and_trained)
{
    dist_context *ctx = test_context();
    dist_net_desc desc;
    dist_gradients grads;
    dist_adam adam;
    unsigned char *bytes;
    size_t size = 0;
    float points[3 * POINTS], target[3 * POINTS], color[3 * POINTS], d_color[3 * POINTS], first = 0.0f, last = 0.0f;
    test_random random = test_random_seed(4);
    memset(&desc, 0, sizeof desc);
    memset(&grads, 0, sizeof grads);
    memset(&adam, 0, sizeof adam);
    desc.layers = 2;
    desc.width = 16;
    desc.code_size = 3;
    desc.color = 1;
    desc.levels = 2;
    dist_net *net = dist_net_create(ctx, &desc);
    REQUIRE(net != NULL && dist_net_channels(net) == 3);
    size_t count = dist_net_weight_count(net);
    float *weights = (float *)calloc(4 * count, sizeof(float)), code[3] = {0.3f, -0.1f, 0.2f}, d_code[3] = {0, 0, 0};
    memcpy(weights, dist_net_weights(net), count * sizeof(float));
    adam.moments = weights + count;
    grads.weights = weights + 3 * count;
    grads.code = d_code;
    dist_shape *shape = dist_shape_create(ctx, net, code);
    dist_field field = dist_shape_field(shape);
    test_random_fill(&random, 3 * POINTS, points, -0.8f, 0.8f);
    for (int i = 0; i < 3 * POINTS; i++) target[i] = 0.5f + 0.4f * (float)sin(2.0 * (double)points[i]);
    for (int step = 0; step < 150; step++) {
        memset(d_color, 0, sizeof d_color);
        memset(grads.weights, 0, count * sizeof(float));
        dist_color_eval(ctx, &field, POINTS, points, color);
        last = dist_loss_color(POINTS, color, target, NULL, 1.0f, d_color);
        if (step == 0) first = last;
        CHECK_STATUS(DIST_OK, dist_color_backward(ctx, &field, POINTS, points, d_color, NULL, &grads), ctx);
        dist_adam_step(&adam, count, weights, grads.weights);
        dist_net_set_weights(ctx, net, weights);
        dist_shape_set_code(shape, code);
    }
    CHECK(last < 0.2f * first);
    CHECK(d_code[0] < 0 || d_code[0] > 0);
    CHECK_STATUS(DIST_OK, dist_net_save(ctx, net, NULL, 0, &size), ctx);
    bytes = (unsigned char *)malloc(size);
    CHECK_STATUS(DIST_OK, dist_net_save(ctx, net, bytes, size, &size), ctx);
    dist_net *again = dist_net_load(ctx, bytes, size);
    dist_shape *other = dist_shape_create(ctx, again, code);
    dist_color_eval(ctx, &field, POINTS, points, color);
    CHECK_STATUS(DIST_OK, dist_shape_eval(ctx, other, POINTS, points, target), ctx);
    CHECK_BYTES(sizeof color, color, target);
    dist_shape_destroy(other);
    dist_net_destroy(again);
    dist_shape_destroy(shape);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    free(bytes);
    free(weights);
}

TEST(color_gradients_too_large_for_floats_spoil_no_weight)
{
    dist_context *ctx = test_context();
    dist_net_desc desc;
    float points[6] = {0.1f, 0.2f, 0.3f, -0.2f, 0.1f, 0.4f};
    memset(&desc, 0, sizeof desc);
    desc.layers = 2;
    desc.width = 16;
    desc.color = 1;
    desc.output_linear = 1;
    dist_net *net = dist_net_create(ctx, &desc);
    REQUIRE(net != NULL);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    dist_field field = dist_shape_field(shape);
    size_t count = dist_net_weight_count(net);
    float *weights = (float *)calloc(count, sizeof(float));
    for (int channel = 0; channel < 3; channel++) {
        float d_color[6] = {0, 0, 0, 0, 0, 0};
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        grads.weights = weights;
        d_color[channel] = d_color[3 + channel] = 3e38f;
        CHECK_STATUS(DIST_OK, dist_color_backward(ctx, &field, 2, points, d_color, NULL, &grads), ctx);
        for (size_t i = 0; i < count; i++) CHECK(test_finite((double)weights[i]));
    }
    dist_shape_destroy(shape), dist_net_destroy(net), dist_context_destroy(ctx);
    free(weights);
}

TEST(spot_with_its_texture_has_the_reference_colors)
{
    enum { N = 128 * 128 };
    static float depth[N], color[3 * N], points[3 * N], there[3 * N];
    static unsigned char mask[N];
    dist_context *ctx = test_context();
    int w, h, c, hits = 0, compared = 0, within = 0;
    double worst = 0.0, steepest = 0.0, length = sqrt(1.4 * 1.4 + 1.0 + 4.0);
    float *reference = dist_pfm_load(ctx, test_data_path("nets/spot_texture.0.color.pfm"), &w, &h, &c);
    if (!reference) {
        dist_context_destroy(ctx);
        SKIP("the real decoders are not here");
    }
    REQUIRE(w == 128 && h == 128 && c == 3);
    float *z = dist_pfm_load(ctx, test_data_path("nets/spot_geometry.0.depth.pfm"), &w, &h, &c);
    dist_net *geometry = dist_net_load_file(ctx, test_data_path("nets/spot_geometry.safetensors"));
    dist_net *texture = dist_net_load_file(ctx, test_data_path("nets/spot_texture.safetensors"));
    dist_shape *shape = dist_shape_create(ctx, geometry, dist_net_code(geometry, 0));
    CHECK_STATUS(DIST_OK, dist_shape_set_texture(shape, texture, NULL), ctx);
    dist_field field = dist_shape_field(shape);
    CHECK_EQUAL(0, field.color_code_size);
    float eye[3] = {(float)(2.4 * 1.4 / length), (float)(2.4 / length), (float)(4.8 / length)};
    float at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(128, 128, (float)(50.0 * 3.14159265358979323846 / 180.0), eye, at, up);
    dist_render_desc how;
    dist_images out;
    memset(&how, 0, sizeof how);
    memset(&out, 0, sizeof out);
    how.epsilon = 1e-6f;
    out.depth = depth;
    out.color = color;
    out.mask = mask;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
    for (int i = 0; i < N; i++) { /* the reference colors are those of the reference's depth */
        float o[3], d[3], ahead = 0.0f;
        hits += mask[i];
        if (!(z[i] > 0.0f)) continue;
        dist_camera_ray(&camera, (float)(i % 128), (float)(i / 128), o, d);
        for (int k = 0; k < 3; k++) ahead += camera.rotation[6 + k] * d[k];
        for (int k = 0; k < 3; k++) points[3 * i + k] = (float)((double)o[k] + (double)(z[i] / ahead) * (double)d[k]);
    }
    CHECK_STATUS(DIST_OK, dist_color_eval(ctx, &field, N, points, there), ctx);
    /* depth and points are floats: within 3e-7 of where the reference, in double, was; what the color changes over that
       and over the two depths' difference is allowed for by its slope, which at the edges of spots is up to 184 */
    for (int k = 0; k < 3; k++) {
        static float d_color[3 * N], slope[3 * N];
        dist_gradients none;
        memset(&none, 0, sizeof none);
        memset(d_color, 0, sizeof d_color);
        memset(slope, 0, sizeof slope);
        for (int i = 0; i < N; i++) d_color[3 * i + k] = 1.0f;
        CHECK_STATUS(DIST_OK, dist_color_backward(ctx, &field, N, points, d_color, slope, &none), ctx);
        for (int i = 0; i < N; i++) {
            double off = fabs((double)depth[i] - (double)z[i]), steep = 0.0;
            if (!mask[i] || !(z[i] > 0.0f) || off > 1e-6) continue;
            for (int j = 3 * i; j < 3 * i + 3; j++) steep += (double)slope[j] * (double)slope[j];
            steep = sqrt(steep);
            double error = fabs((double)there[3 * i + k] - (double)reference[3 * i + k]);
            double drawn = fabs((double)color[3 * i + k] - (double)reference[3 * i + k]);
            compared++;
            within += drawn <= 1e-5;
            steepest = fmax(steepest, steep);
            worst = fmax(worst, fmax(error, drawn - 1.2 * off * steep) - 3e-7 * steep);
        }
    }
    if (test_state.verbose)
        printf("    %d of %d hits, %d of %d colors within 1e-5, beyond the slope's share %.1e, slope up to %.0f\n",
               compared / 3, hits, within, compared, worst, steepest);
    CHECK(compared > 3 * hits / 2 && hits > 2000);
    CHECK(within >= 0.99 * compared);
    CHECK_NEAR(0.0, worst, 1e-5);
    dist_pfm_free(ctx, reference, 128, 128, 3);
    dist_pfm_free(ctx, z, 128, 128, 1);
    dist_shape_destroy(shape);
    dist_net_destroy(geometry);
    dist_net_destroy(texture);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(color_backward_at_points_matches_differences);
    RUN(color_backward_of_pictures_matches_differences);
    RUN(color_backward_is_the_same_where_depth_is_weighted_by_the_normal);
    RUN(color_backward_of_placed_shapes_matches_differences);
    RUN(a_color_code_is_recovered_from_one_picture_with_either_tracer);
    RUN(color_gradients_have_the_same_bits_for_every_number_of_workers_and_whatever_else_is_wanted);
    RUN(color_queries_are_counted_and_none_made_where_no_color_is_asked_for);
    RUN(codes_of_a_textured_shape_are_set_one_by_one);
    RUN(color_of_a_field_that_is_older_than_its_texture_is_refused);
    RUN(color_gradients_of_another_color_code_or_other_weights_are_refused);
    RUN(colors_of_own_fields_lose_no_gradient_to_what_is_not_finite);
    RUN(memory_refused_to_a_texture_leaves_the_shape_as_it_was);
    RUN(a_texture_that_does_not_fit_and_gradients_that_are_not_there_are_refused);
    RUN(a_texture_net_is_created_saved_and_trained);
    RUN(color_gradients_too_large_for_floats_spoil_no_weight);
    RUN(spot_with_its_texture_has_the_reference_colors);
    return test_report();
}
