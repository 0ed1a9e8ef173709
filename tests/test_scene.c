/* SPDX-License-Identifier: MIT-0
   test_scene.c - several placed fields as one: values, gradients for every code and placement, pictures, fits, queries;
   against the definition worked out in double without leaving anything out. */
#include "test.h"

#include "model.h"
#include "shapes.h"

enum { PARTS = 24, NUMBERS = 24 };

/* An instance in double, and its float twin. */
typedef struct part {
    int kind, code_size;
    const model *m;
    double code[MODEL_CODE], scale, rotation[9], translation[3], radius;
    float codef[MODEL_CODE];
    dist_field field;
    dist_similarity placement;
    dist_shape *shape;
} part;

typedef struct world {
    int count;
    part part[PARTS];
    dist_context *ctx;
    dist_scene *scene;
    dist_field field;
} world;

/* f_i at p. margin: NULL, or made smaller where a kink is nearer: of d, of b against its cap, of ReLUs and the box.
   capped 0: the lower bound goes on without a cap, as nobody computes it. */
static double part_value(const part *a, const double p[3], int capped, double *margin)
{
    double x[3], q[3], n[3], length = 0, r = a->radius, m = 0.2 * r, closest = 1e300;
    for (int i = 0; i < 3; i++) x[i] = (p[i] - a->translation[i]) / a->scale;
    for (int i = 0; i < 3; i++) {
        q[i] = a->rotation[i] * x[0] + a->rotation[3 + i] * x[1] + a->rotation[6 + i] * x[2];
        n[i] = q[i] - (double)a->field.center[i];
        length += n[i] * n[i];
    }
    length = sqrt(length);
    double d = length - r, b;
    for (int i = 0; i < 3 && d > 0; i++) q[i] = (double)a->field.center[i] + r * n[i] / length;
    b = model_field(a->kind, a->m, a->code, q);
    if (margin && a->kind == NET) model_channels(a->m, a->m->params, a->code, q, NULL, NULL, &closest);
    if (margin && a->kind == BOX)
        for (int i = 0; i < 3; i++) closest = fmin(closest, fabs(fabs(q[i] - a->code[i]) - a->code[3 + i]));
    if (margin) *margin = fmin(*margin, fmin(closest, fabs(d)));
    if (d > 0) {
        if (margin) *margin = fmin(*margin, fabs(b));
        b = sqrt(d * d + fmax(b, 0) * fmax(b, 0));
    }
    double cap = m + fabs(d - m);
    if (margin && d < m) *margin = fmin(*margin, fabs(b - cap));
    if (margin) *margin = fmin(*margin, fabs(d - m));
    return a->scale * (capped ? fmin(b, cap) : b);
}

static double world_value(const world *w, const double p[3], int capped, int *nearest, double *margin)
{
    double best = 1e300, second = 1e300;
    if (margin) *margin = 1e300;
    for (int k = 0; k < w->count; k++) {
        double f = part_value(&w->part[k], p, capped, margin);
        if (f < best) {
            second = best;
            best = f;
            if (nearest) *nearest = k;
        } else {
            second = fmin(second, f);
        }
    }
    if (margin) *margin = fmin(*margin, second - best);
    return best;
}

/* exp([w]x) m, scale and translation, in double. */
static void part_move(part *a, int number, double by)
{
    if (number == 0) a->scale *= exp(by);
    if (number > 3) a->translation[number - 4] += by;
    if (number < 1 || number > 3) return;
    int i = number % 3, j = (number + 1) % 3; /* the axes that turn into each other: around x: y into z */
    for (int k = 0; k < 3; k++) {
        double x = a->rotation[3 * i + k], y = a->rotation[3 * j + k];
        a->rotation[3 * i + k] = cos(by) * x - sin(by) * y;
        a->rotation[3 * j + k] = sin(by) * x + cos(by) * y;
    }
}

static void part_number(part *a, int number, double by)
{
    if (number < a->code_size) a->code[number] += by;
    else part_move(a, number - a->code_size, by);
}

static part part_make(dist_context *ctx, int kind, const model *m, const dist_net *net, test_random *random)
{
    static const float codes[3][6] = {
        {0.1f, -0.05f, 0.05f, 0.6f}, {0.05f, 0.02f, -0.04f, 0.55f, 0.2f}, {0.05f, -0.05f, 0.02f, 0.5f, 0.35f, 0.45f}};
    part a;
    memset(&a, 0, sizeof a);
    a.kind = kind;
    a.m = m;
    a.code_size = kind == NET ? m->desc.code_size : 4 + kind;
    for (int i = 0; i < a.code_size; i++) {
        a.codef[i] = kind == NET ? test_random_float(random, 0.2f, 0.3f) : codes[kind][i];
        a.code[i] = (double)a.codef[i];
    }
    if (kind == NET) a.shape = dist_shape_create(ctx, net, a.codef);
    return a;
}

/* After the part has come to stay where it is: fields borrow codef. */
static void part_finish(part *a)
{
    a->field = a->kind == NET      ? dist_shape_field(a->shape)
               : a->kind == SPHERE ? dist_field_sphere(a->codef)
               : a->kind == TORUS  ? dist_field_torus(a->codef)
                                   : dist_field_box(a->codef);
    a->radius = (double)a->field.radius;
    a->scale = (double)a->placement.scale;
    for (int i = 0; i < 9; i++) a->rotation[i] = (double)a->placement.rotation[i];
    for (int i = 0; i < 3; i++) a->translation[i] = (double)a->placement.translation[i];
}

static void part_place(part *a, float scale, test_random *random, float x, float y, float z)
{
    float step[7] = {logf(scale), 0, 0, 0, x, y, z};
    test_random_fill(random, 3, step + 1, -1.5f, 1.5f);
    dist_similarity_move(&a->placement, step);
}

static void world_open(world *w)
{
    dist_instance instances[PARTS];
    memset(instances, 0, sizeof instances);
    for (int k = 0; k < w->count; k++) {
        part_finish(&w->part[k]);
        instances[k].field = &w->part[k].field;
        instances[k].placement = w->part[k].placement;
    }
    w->scene = dist_scene_create(w->ctx, w->count, instances);
    w->field = dist_scene_field(w->scene);
}

static void world_close(world *w)
{
    dist_scene_destroy(w->scene);
    for (int k = 0; k < w->count; k++) dist_shape_destroy(w->part[k].shape);
}

static const model_desc nets[] = {
    {.name = "relu", .code_size = 2, .width = 16, .clamp = 0.3},
    {.name = "elu with skip", .code_size = 3, .activation = DIST_ACTIVATION_ELU, .skip = 4, .output = MODEL_NONE},
    {.name = "softplus", .code_size = 2, .activation = DIST_ACTIVATION_SOFTPLUS, .first_scale = 4.0},
    {.name = "sine",
     .code_size = 2,
     .activation = DIST_ACTIVATION_SINE,
     .first_scale = 4.0,
     .scale = 1.5,
     .output = MODEL_NONE},
    {.name = "tanh", .code_size = 3, .activation = DIST_ACTIVATION_TANH, .clamp = 0.3},
    {.name = "none with fourier",
     .code_size = 2,
     .activation = DIST_ACTIVATION_NONE,
     .fourier = 1,
     .levels = 1,
     .base = 1.5}};

enum { NETS = sizeof nets / sizeof nets[0] };

/* One net of each activation between the three analytic fields; near[0] and [1] overlap. */
typedef struct mixture {
    world w;
    model m;
    dist_net *net;
} mixture;

static void mixture_open(mixture *x, int which, dist_context *ctx)
{
    test_random random = test_random_seed(100 + (unsigned)which);
    memset(x, 0, sizeof *x);
    x->m = model_make(&nets[which], 40 + (unsigned)which);
    part *parts = x->w.part;
    double code[MODEL_CODE];
    for (int i = 0; i < MODEL_CODE; i++) code[i] = 0.25;
    model_fit_ball(&x->m, code, 0.6);
    x->w.ctx = ctx;
    x->net = model_load(ctx, &x->m);
    x->w.count = 4;
    for (int k = 0; k < 4; k++) parts[k] = part_make(ctx, k == 3 ? NET : k, &x->m, x->net, &random);
    part_place(&parts[0], 0.7f, &random, -0.5f, 0.1f, 0.0f);
    part_place(&parts[1], 1.3f, &random, 0.5f, -0.2f, 0.2f);
    part_place(&parts[2], 0.5f, &random, 0.2f, 1.6f, -0.1f);
    part_place(&parts[3], 0.8f, &random, -1.3f, -1.2f, 0.3f);
    world_open(&x->w);
}

static void mixture_close(mixture *x)
{
    world_close(&x->w);
    dist_net_destroy(x->net);
    model_free(&x->m);
}

static void random_points(test_random *random, int n, double size, float *points)
{
    for (int i = 0; i < 3 * n; i++) points[i] = test_random_float(random, (float)-size, (float)size);
}

/* Within `reach` radii of the instances' centers. */
static void near_points(test_random *random, const world *w, int n, double reach, float *points)
{
    for (int i = 0; i < n; i++) {
        float ball[4], u[3];
        inside_ball(w->scene, i % w->count, ball);
        float r = ball[3] * test_random_float(random, 0, (float)reach);
        test_random_direction(random, u);
        for (int k = 0; k < 3; k++) points[3 * i + k] = ball[k] + r * u[k];
    }
}

static void point_of(const float *points, int i, double p[3])
{
    for (int k = 0; k < 3; k++) p[k] = (double)points[3 * i + k];
}

TEST(a_scene_is_the_least_of_its_placed_fields)
{
    enum { N = 3000 };
    static float points[3 * N], sdf[N], again[N], gradient[3 * N];
    static int index[N];
    dist_context *ctx = test_context();
    for (int which = 0; which < NETS; which++) {
        mixture x;
        test_random random = test_random_seed(7);
        int judged = 0, other = 0, exact = 0;
        double worst = 0, worst_exact = 0;
        mixture_open(&x, which, ctx);
        random_points(&random, N / 2, 3.0, points);
        near_points(&random, &x.w, N / 2, 1.3, points + 3 * (N / 2));
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &x.w.field, N, points, sdf, NULL), ctx);
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &x.w.field, N, points, again, gradient), ctx);
        CHECK_STATUS(DIST_OK, dist_scene_find(x.w.scene, N, points, index), ctx);
        for (int i = 0; i < N; i++) {
            double p[3], margin;
            int nearest = -1;
            point_of(points, i, p);
            double f = world_value(&x.w, p, 1, &nearest, &margin), union_f = world_value(&x.w, p, 0, NULL, NULL);
            worst = fmax(worst, fmax(fabs(f - (double)sdf[i]), fabs(f - (double)again[i])));
            CHECK(f <= union_f + 1e-12);
            other += margin > 1e-4 && index[i] != nearest;
            judged++;
            if (f >= 0.15 * x.w.part[2].scale * x.w.part[2].radius) continue; /* below every fifth of a radius */
            exact++;
            worst_exact = fmax(worst_exact, fabs(union_f - (double)sdf[i]));
        }
        CHECK_NEAR(0, worst, 3e-6);
        CHECK_NEAR(0, worst_exact, 3e-6);
        CHECK_EQUAL(0, other);
        CHECK(exact > 400);
        mixture_close(&x);
    }
    dist_context_destroy(ctx);
}

/* Nothing is asked outside its own sphere. */
typedef struct watched {
    float numbers[4];
    double farthest;
} watched;

static void watched_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    watched *x = (watched *)user;
    for (size_t i = 0; i < n; i++) {
        double p[3] = {(double)points[3 * i], (double)points[3 * i + 1], (double)points[3 * i + 2]};
        x->farthest = fmax(x->farthest, sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]));
    }
    dist_field sphere = dist_field_sphere(x->numbers);
    sphere.eval_fn(sphere.user, worker, n, points, sdf, gradient);
}

TEST(no_field_is_asked_outside_its_sphere)
{
    enum { N = 4000 };
    static float points[3 * N], sdf[N], gradient[3 * N];
    watched x = {{0, 0, 0, 0.5f}, 0};
    dist_context *ctx = test_context();
    dist_field field = dist_field_sphere(x.numbers);
    dist_instance instances[2];
    test_random random = test_random_seed(5);
    field.user = &x;
    field.eval_fn = watched_eval;
    field.radius = 0.8f;
    memset(instances, 0, sizeof instances);
    instances[0].field = instances[1].field = &field;
    instances[0].placement.scale = 0.25f;
    instances[0].placement.translation[0] = 3.0f;
    dist_scene *scene = dist_scene_create(ctx, 2, instances);
    dist_field all = dist_scene_field(scene);
    random_points(&random, N, 4.0, points);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &all, N, points, sdf, gradient), ctx);
    CHECK(x.farthest > 0.79);
    CHECK(x.farthest <= 0.8 * (1 + 3e-7));
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

/* The formulas of the adjoint in double: 1e-6. */
TEST(the_adjoint_of_a_placement_is_its_derivative_in_double)
{
    dist_context *ctx = test_context();
    mixture x;
    test_random random = test_random_seed(11);
    mixture_open(&x, 2, ctx);
    int judged = 0;
    for (int i = 0; i < 400; i++) {
        double p[3], g[3], margin, expected[7], r[3];
        int k = 0;
        for (int axis = 0; axis < 3; axis++) p[axis] = test_random_double(&random, -2, 2);
        double f = world_value(&x.w, p, 1, &k, &margin);
        if (margin < 1e-4) continue;
        for (int axis = 0; axis < 3; axis++) {
            double a[3] = {p[0], p[1], p[2]}, b[3] = {p[0], p[1], p[2]};
            a[axis] += 1e-5;
            b[axis] -= 1e-5;
            g[axis] = (world_value(&x.w, a, 1, NULL, NULL) - world_value(&x.w, b, 1, NULL, NULL)) / 2e-5;
            r[axis] = p[axis] - x.w.part[k].translation[axis];
        }
        expected[0] = f - g[0] * r[0] - g[1] * r[1] - g[2] * r[2];
        for (int axis = 0; axis < 3; axis++) {
            int a = (axis + 1) % 3, b = (axis + 2) % 3;
            expected[1 + axis] = g[a] * r[b] - g[b] * r[a];
            expected[4 + axis] = -g[axis];
        }
        for (int number = 0; number < 7; number++) {
            part keep = x.w.part[k];
            part_move(&x.w.part[k], number, 1e-5);
            double up = world_value(&x.w, p, 1, NULL, NULL);
            x.w.part[k] = keep;
            part_move(&x.w.part[k], number, -1e-5);
            double down = world_value(&x.w, p, 1, NULL, NULL);
            x.w.part[k] = keep;
            CHECK_NEAR(expected[number], (up - down) / 2e-5, 1e-6);
        }
        judged++;
    }
    CHECK(judged > 360);
    mixture_close(&x);
    dist_context_destroy(ctx);
}

/* Value, gradient and adjoint of what the library computes, against differences of the definition in double. */
TEST(gradients_for_points_codes_and_placements_are_those_of_double)
{
    enum { N = 500 };
    static float points[3 * N], sdf[N], gradient[3 * N], seeds[N], d_points[3 * N], d_code[200];
    dist_context *ctx = test_context();
    for (int which = 0; which < NETS; which++) {
        mixture x;
        test_random random = test_random_seed(21 + (unsigned)which);
        int n = 0, tried = 0;
        float near[12];
        mixture_open(&x, which, ctx);
        while (n < N && tried < 20 * N) {
            double p[3], margin;
            if (tried++ % 4) near_points(&random, &x.w, 4, 1.2, near);
            else random_points(&random, 4, 2.5, near);
            memcpy(points + 3 * n, near + 3 * (tried / 4 % 4), 3 * sizeof(float));
            point_of(points, n, p);
            world_value(&x.w, p, 1, NULL, &margin);
            n += margin > 1e-4;
        }
        CHECK_EQUAL(N, n);
        CHECK(tried < N * 10 / 9); /* the rest was too near a kink */
        for (int i = 0; i < N; i++) seeds[i] = test_random_float(&random, -1, 1);
        memset(d_points, 0, sizeof d_points);
        memset(d_code, 0, sizeof d_code);
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        grads.code = d_code;
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &x.w.field, N, points, sdf, gradient), ctx);
        CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &x.w.field, N, points, seeds, NULL, NULL, d_points, &grads),
                     ctx);
        double worst = 0, worst_pull = 0;
        for (int i = 0; i < N; i++)
            for (int axis = 0; axis < 3; axis++) {
                double a[3], b[3];
                point_of(points, i, a);
                point_of(points, i, b);
                a[axis] += 1e-6;
                b[axis] -= 1e-6;
                double g = (world_value(&x.w, a, 1, NULL, NULL) - world_value(&x.w, b, 1, NULL, NULL)) / 2e-6;
                worst = fmax(worst, fabs(g - (double)gradient[3 * i + axis]));
                worst_pull = fmax(worst_pull, fabs(g * (double)seeds[i] - (double)d_points[3 * i + axis]));
            }
        CHECK_NEAR(0, worst, 1e-4);
        CHECK_NEAR(0, worst_pull, 1e-4);
        CHECK_EQUAL(x.w.field.code_size, dist_scene_offset(x.w.scene, x.w.count));
        double largest = 0;
        for (int j = 0; j < x.w.field.code_size; j++) largest = fmax(largest, fabs((double)d_code[j]));
        for (int k = 0; k < x.w.count; k++) {
            int first = dist_scene_offset(x.w.scene, k), size = dist_scene_offset(x.w.scene, k + 1) - first;
            CHECK_EQUAL(x.w.part[k].code_size + 7, size);
            for (int j = 0; j < size; j++) {
                double sum = 0;
                part keep = x.w.part[k];
                for (int i = 0; i < N; i++) {
                    double p[3];
                    point_of(points, i, p);
                    part_number(&x.w.part[k], j, 1e-6);
                    double up = world_value(&x.w, p, 1, NULL, NULL);
                    x.w.part[k] = keep;
                    part_number(&x.w.part[k], j, -1e-6);
                    sum += (double)seeds[i] * (up - world_value(&x.w, p, 1, NULL, NULL)) / 2e-6;
                    x.w.part[k] = keep;
                }
                CHECK_NEAR(sum, d_code[first + j], 2e-4 * largest);
            }
        }
        mixture_close(&x);
    }
    dist_context_destroy(ctx);
}

static void seed_half(void *user, size_t first, size_t count, const float *sdf, const float *gradient, float *d_sdf)
{
    (void)sdf, (void)gradient;
    for (size_t i = 0; i < count; i++) d_sdf[i] = 0.5f * ((const float *)user)[first + i];
}

/* Two instances of one net, one of another and a sphere: the nets' weights stand in the scene's once each. Against
   differences of the definition in double. */
TEST(gradients_for_weights_are_those_of_double_each_nets_once)
{
    enum { N = 300, TRIED = 24 };
    static float points[3 * N], seeds[N], d_sdf[N], d_points[2][3 * N], d_code[2][200];
    dist_context *ctx = test_context();
    for (int which = 0; which < NETS; which++) {
        model m[2];
        dist_net *net[2];
        world w;
        test_random random = test_random_seed(61 + (unsigned)which);
        double code[MODEL_CODE];
        memset(&w, 0, sizeof w);
        for (int i = 0; i < MODEL_CODE; i++) code[i] = 0.25;
        for (int k = 0; k < 2; k++) {
            m[k] = model_make(&nets[(which + k) % NETS], 70 + (unsigned)(which + k));
            model_fit_ball(&m[k], code, 0.6);
            net[k] = model_load(ctx, &m[k]);
        }
        w.ctx = ctx;
        w.count = 4;
        for (int k = 0; k < 4; k++)
            w.part[k] = part_make(ctx, k == 2 ? SPHERE : NET, &m[k == 1], net[k == 1], &random);
        part_place(&w.part[0], 0.7f, &random, -0.5f, 0.1f, 0.0f); /* it overlaps with the next */
        part_place(&w.part[1], 1.3f, &random, 0.5f, -0.2f, 0.2f);
        part_place(&w.part[2], 0.5f, &random, 0.2f, 1.6f, -0.1f);
        part_place(&w.part[3], 0.8f, &random, -1.3f, -1.2f, 0.3f);
        world_open(&w);
        size_t count[2] = {dist_net_weight_count(net[0]), dist_net_weight_count(net[1])};
        CHECK_EQUAL(count[0] + count[1], w.field.weight_count);
        CHECK_EQUAL(0, dist_scene_weight_offset(w.scene, 0, 0));
        CHECK_EQUAL(count[0], dist_scene_weight_offset(w.scene, 1, 0));
        CHECK_EQUAL(0, dist_scene_weight_offset(w.scene, 3, 0));
        CHECK_EQUAL((size_t)-1, dist_scene_weight_offset(w.scene, 4, 0));
        int n = 0;
        for (int tried = 0; n < N && tried < 20 * N; tried++) {
            double p[3], margin;
            near_points(&random, &w, 1 + tried % 4, 1.2, d_points[0]);
            memcpy(points + 3 * n, d_points[0] + 3 * (tried % 4), 3 * sizeof(float));
            point_of(points, n, p);
            world_value(&w, p, 1, NULL, &margin);
            n += margin > 1e-4;
        }
        REQUIRE(n == N);
        test_random_fill(&random, N, seeds, -1.0f, 1.0f);
        float *weights = (float *)calloc(3 * w.field.weight_count, sizeof(float));
        REQUIRE(weights != NULL);
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        memset(d_points, 0, sizeof d_points);
        memset(d_code, 0, sizeof d_code);
        for (int run = 0; run < 3; run++) { /* with the codes and points, without, half of it by seed_fn */
            grads.weights = weights + (size_t)run * w.field.weight_count;
            grads.code = run == 0 ? d_code[0] : NULL;
            memcpy(d_sdf, seeds, sizeof d_sdf);
            CHECK_STATUS(DIST_OK,
                         dist_field_backward(ctx, &w.field, N, points, d_sdf, run == 2 ? seed_half : NULL, seeds,
                                             run == 0 ? d_points[0] : NULL, &grads), ctx);
        }
        for (int i = 0; i < N; i++) CHECK_NEAR(0.5 * (double)seeds[i], d_sdf[i], 0);
        for (size_t i = 0; i < w.field.weight_count; i++) {
            CHECK_NEAR((double)weights[i], weights[w.field.weight_count + i], 0);
            CHECK_NEAR(0.5 * (double)weights[i], weights[2 * w.field.weight_count + i], 0);
        }
        grads.weights = NULL;
        grads.code = d_code[1];
        CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &w.field, N, points, seeds, NULL, NULL, d_points[1], &grads),
                     ctx);
        CHECK_NEAR_ARRAY(3 * N, d_points[1], d_points[0], 0);
        CHECK_NEAR_ARRAY(200, d_code[1], d_code[0], 1e-5);
        double largest = 0, worst = 0;
        for (size_t i = 0; i < w.field.weight_count; i++) largest = fmax(largest, fabs((double)weights[i]));
        for (int t = 0; t < 2 * TRIED; t++) { /* the last are of the last layer */
            int k = t % 2, last = (int)count[k] - 8;
            int at = test_random_int(&random, t < TRIED ? 0 : last, (int)count[k] - 1);
            double *x = &m[k].params[at], old = *x, sum = 0;
            for (int i = 0; i < N; i++) {
                double p[3], up;
                point_of(points, i, p);
                *x = old + 1e-6;
                up = world_value(&w, p, 1, NULL, NULL);
                *x = old - 1e-6;
                sum += (double)seeds[i] * (up - world_value(&w, p, 1, NULL, NULL)) / 2e-6;
            }
            *x = old;
            worst = fmax(worst, fabs(sum - (double)weights[(k ? count[0] : 0) + (size_t)at]));
        }
        if (test_state.verbose) printf("    %s: %.1e of %.3g\n", nets[which].name, worst, largest);
        CHECK(largest > 1.0);
        CHECK(worst < 2e-4 * largest);
        free(weights);
        world_close(&w);
        for (int k = 0; k < 2; k++) {
            dist_net_destroy(net[k]);
            model_free(&m[k]);
        }
    }
    dist_context_destroy(ctx);
}

/* Through pictures: of a scene of one, of a scene of it, and of that beside others that the camera does not see, the
   gradient for the weights is the shape's own. Through points, of all that a net gives the color of. */
TEST(weights_are_reached_through_pictures_colors_and_scenes_of_scenes)
{
    enum { S = 32, P = S * S, N = 200 };
    static float seen[P], depth[P], normal[3 * P], color[3 * P];
    static float d_depth[P], d_normal[3 * P], d_color[3 * P], points[3 * N];
    static const model_desc own = {.name = "colored", .code_size = 2, .channels = "sdf,r,g,b", .clamp = 0.3};
    static const model_desc paint = {.name = "texture", .code_size = 5, .channels = "r,g,b", .output = MODEL_SIGMOID};
    dist_context *ctx = test_context();
    for (int textured = 0; textured < 2; textured++) {
        model m[2];
        dist_net *net[2];
        dist_shape *shape[2];
        dist_field field[2];
        dist_scene *scene[3];
        dist_instance at[4];
        float codes[2][3] = {{0.25f, 0.2f}, {0.2f, 0.3f}}, paints[3] = {0.3f, -0.2f, 0.4f};
        double code[MODEL_CODE];
        test_random random = test_random_seed(5);
        for (int i = 0; i < MODEL_CODE; i++) code[i] = 0.25;
        m[0] = model_make(&own, 5);
        m[1] = model_make(&paint, 5);
        model_fit_ball(&m[0], code, 0.6);
        memset(at, 0, sizeof at);
        for (int k = 0; k < 2; k++) net[k] = model_load(ctx, &m[k]);
        for (int k = 0; k < 2; k++) {
            shape[k] = dist_shape_create(ctx, net[0], codes[k]);
            if (textured) CHECK_STATUS(DIST_OK, dist_shape_set_texture(shape[k], net[1], paints), ctx);
            field[k] = dist_shape_field(shape[k]);
        }
        dist_field all[4] = {field[0]};
        at[0].field = &all[0];
        scene[0] = dist_scene_create(ctx, 1, at);
        all[1] = dist_scene_field(scene[0]);
        at[0].field = &all[1];
        scene[1] = dist_scene_create(ctx, 1, at);
        all[2] = dist_scene_field(scene[1]);
        at[0].field = &field[0];
        at[1].field = &field[1]; /* behind the camera */
        at[1].placement.translation[2] = 40.0f;
        scene[2] = dist_scene_create(ctx, 2, at);
        all[3] = dist_scene_field(scene[2]);
        size_t count = dist_net_weight_count(net[0]), colors = textured ? dist_net_weight_count(net[1]) : 0;
        float *weights = (float *)calloc(4 * (count + colors), sizeof(float));
        REQUIRE(weights != NULL);
        float eye[3] = {0.3f, 0.4f, 2.2f}, up[3] = {0, 1, 0};
        dist_camera camera = dist_camera_look_at(S, S, 0.8f, eye, NULL, up);
        dist_render_desc how;
        dist_images out, d_out;
        memset(&how, 0, sizeof how);
        memset(&out, 0, sizeof out);
        memset(&d_out, 0, sizeof d_out);
        how.normal_delta = 1e-3f;
        how.epsilon = 1e-5f;
        out.depth = depth, out.normal = normal, out.color = color;
        d_out.depth = d_depth, d_out.normal = d_normal, d_out.color = d_color;
        test_random_fill(&random, P, d_depth, -1.0f, 1.0f);
        test_random_fill(&random, 3 * P, d_normal, -0.1f, 0.1f);
        test_random_fill(&random, 3 * P, d_color, -1.0f, 1.0f);
        int others = 0; /* pixels that show something else */
        for (int k = 0; k < 4; k++) {
            CHECK_STATUS(DIST_OK, dist_render(ctx, &all[k], &camera, &how, &out, NULL), ctx);
            if (k == 0) memcpy(seen, depth, sizeof seen);
            for (int i = 0; i < P; i++) others += fabs((double)depth[i] - (double)seen[i]) > 1e-5;
        }
        CHECK_EQUAL(0, others);
        dist_tape *tape = dist_tape_create(ctx, &camera, &how);
        for (int k = 0; k < 4; k++) {
            float *to = weights + (size_t)k * (count + colors);
            dist_gradients grads;
            memset(&grads, 0, sizeof grads);
            CHECK_EQUAL(count, all[k].weight_count);
            CHECK_EQUAL(colors, all[k].color_weight_count);
            grads.weights = to;
            grads.color_weights = textured ? to + count : NULL;
            CHECK_STATUS(DIST_OK, dist_render(ctx, &all[k], &camera, &how, &out, tape), ctx);
            CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
            double square = 0, differ = 0, texture = 0, differ_texture = 0;
            for (size_t i = 0; i < count + colors; i++) {
                double a = (double)weights[i], b = (double)to[i] - a;
                if (i < count) square += a * a, differ += b * b;
                else texture += a * a, differ_texture += b * b;
            }
            if (test_state.verbose)
                printf("    %d: %.1e of %.3g, %.1e of %.3g\n", k, sqrt(differ), sqrt(square), sqrt(differ_texture),
                       sqrt(texture));
            CHECK(square > 1.0 && differ < 1e-8 * square);
            CHECK(!textured || (texture > 1.0 && differ_texture < 1e-8 * texture));
        }
        dist_tape_destroy(tape);
        /* the second instance paints as well: what each adds by itself */
        float shift[2] = {0, 40.0f}, *sum = weights, *got = weights + (count + colors);
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        memset(weights, 0, 2 * (count + colors) * sizeof(float));
        for (int i = 0; i < N; i++) {
            float direction[3];
            test_random_direction(&random, direction);
            for (int k = 0; k < 3; k++) points[3 * i + k] = 0.7f * direction[k];
        }
        for (int k = 0; k < 2; k++) {
            *(textured ? &grads.color_weights : &grads.weights) = sum + (textured ? count : 0);
            CHECK_STATUS(DIST_OK, dist_color_backward(ctx, &field[k], N / 2, points + k * 3 * (N / 2),
                                                      d_color + k * 3 * (N / 2), NULL, &grads), ctx);
            for (int i = 0; i < N / 2; i++) points[3 * (i + k * (N / 2)) + 2] += shift[k];
        }
        *(textured ? &grads.color_weights : &grads.weights) = got + (textured ? count : 0);
        CHECK_STATUS(DIST_OK, dist_color_backward(ctx, &all[3], N, points, d_color, NULL, &grads), ctx);
        double largest = 0, worst = 0;
        for (size_t i = 0; i < count + colors; i++) {
            largest = fmax(largest, fabs((double)sum[i]));
            worst = fmax(worst, fabs((double)sum[i] - (double)got[i]));
        }
        CHECK(largest > 0.1 && worst < 1e-4 * largest);
        /* a field with other weights in its place: the old one is refused, a new one is not */
        model bigger = model_make(&nets[0], 3);
        dist_net *other = model_load(ctx, &bigger);
        dist_shape *shapes = dist_shape_create(ctx, other, codes[0]);
        dist_field another = dist_shape_field(shapes);
        at[1].field = &another;
        another.color_fn = field[0].color_fn; /* never called: it has to have one */
        another.color_adjoint_fn = field[0].color_adjoint_fn;
        another.color_code_size = field[0].color_code_size;
        CHECK_STATUS(DIST_OK, dist_scene_set(scene[2], 1, &at[1]), ctx);
        memset(&grads, 0, sizeof grads);
        grads.weights = got;
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_backward(ctx, &all[3], N, points, d_color, NULL, NULL, NULL, &grads),
                     ctx);
        CHECK_TEXT("more or fewer weights since its field was taken", dist_context_message(ctx));
        dist_context_clear(ctx);
        CHECK_EQUAL(count + dist_net_weight_count(other), dist_scene_field(scene[2]).weight_count);
        CHECK(dist_scene_field(scene[2]).color_weights_fn == NULL);
        free(weights);
        for (int k = 2; k >= 0; k--) dist_scene_destroy(scene[k]);
        dist_shape_destroy(shapes);
        dist_net_destroy(other);
        model_free(&bigger);
        for (int k = 0; k < 2; k++) dist_shape_destroy(shape[k]);
        for (int k = 0; k < 2; k++) {
            dist_net_destroy(net[k]);
            model_free(&m[k]);
        }
    }
    dist_context_destroy(ctx);
}

/* ---- pictures ---------------------------------------------------------------------------------------------------- */

enum { SIDE = 96, PIXELS = SIDE * SIDE };

typedef shape_picture picture;

static picture first, second;
static float first_error[PIXELS], first_distance[PIXELS];

static dist_camera camera_for(const dist_field *field, int side)
{
    float up[3] = {0, 1, 0}, eye[3] = {field->center[0] + 1.3f * field->radius, field->center[1] + 0.9f * field->radius,
                                       field->center[2] + 2.0f * field->radius};
    return dist_camera_look_at(side, side, 0.8f, eye, field->center, up);
}

/* Pixels whose masks differ, or whose depths by more than both errors and float's rounding. */
static int compare(const picture *a, const picture *b)
{
    int differ = 0;
    for (int i = 0; i < PIXELS; i++) {
        double off = fabs((double)a->depth[i] - (double)b->depth[i]);
        double allowed = (double)a->error[i] + (double)b->error[i] + 3e-6 * (double)a->depth[i];
        int grazes = fabs((double)a->silhouette[i]) < 6e-5 && fabs((double)b->silhouette[i]) < 6e-5; /* about epsilon */
        differ += (a->mask[i] != b->mask[i] && !grazes) || (a->mask[i] && b->mask[i] && off > allowed);
    }
    return differ;
}

static int hits_of(const picture *p)
{
    int hits = 0;
    for (int i = 0; i < PIXELS; i++) hits += p->mask[i];
    return hits;
}

/* A field of one's own that asks every instance everywhere, in float. */
static void union_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const world *w = (const world *)user;
    for (size_t i = 0; i < n; i++) {
        float best = 3e38f;
        for (int k = 0; k < w->count; k++) {
            const part *a = &w->part[k];
            const float *rotation = a->placement.rotation;
            float f, ask[3], g[3], turned[3], d = inside_local(w->scene, k, points + 3 * i, ask);
            a->field.eval_fn(a->field.user, worker, 1, ask, &f, g);
            for (int axis = 0; axis < 3; axis++)
                turned[axis] = rotation[3 * axis] * g[0] + rotation[3 * axis + 1] * g[1] +
                               rotation[3 * axis + 2] * g[2];
            f *= a->placement.scale;
            if (d > 0.0f) f = sqrtf(d * d + fmaxf(f, 0.0f) * fmaxf(f, 0.0f));
            if (f >= best) continue;
            best = f;
            if (gradient) memcpy(gradient + 3 * i, turned, sizeof turned);
        }
        sdf[i] = best;
    }
}

TEST(a_scene_looks_like_the_union_that_asks_everything)
{
    dist_context *ctx = test_context();
    for (int which = 0; which < (test_quick() ? 2 : NETS); which++) {
        mixture x;
        mixture_open(&x, which, ctx);
        dist_field all = x.w.field;
        all.user = &x.w;
        all.eval_fn = union_eval;
        all.fused_fn = NULL;
        all.code_size = 0;
        dist_camera camera = camera_for(&all, SIDE);
        dist_images out = shape_planes(&first), plain = shape_planes(&second);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &x.w.field, &camera, NULL, &out, NULL), ctx);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &all, &camera, NULL, &plain, NULL), ctx);
        int differ = compare(&first, &second), hits = hits_of(&first);
        CHECK(hits > PIXELS / 20);
        CHECK(differ <= hits / 100); /* grazing rays at edges, which either tracing may miss */
        double off = 0;
        for (int i = 0; i < PIXELS; i++) {
            if (!first.mask[i] || !second.mask[i]) continue;
            double dot = 0;
            for (int k = 0; k < 3; k++) dot += (double)first.normal[3 * i + k] * (double)second.normal[3 * i + k];
            off += dot < 0.999;
        }
        CHECK(off <= 0.03 * hits); /* at edges and creases the two hits may lie on two sides */
        if (test_state.verbose)
            printf("    %s: %d hits, %d differ, queries %llu and %llu\n", nets[which].name, hits, differ,
                   first.stats.queries, second.stats.queries);
        mixture_close(&x);
    }
    dist_context_destroy(ctx);
}

TEST(a_scene_of_one_unmoved_instance_looks_like_its_field)
{
    dist_context *ctx = test_context();
    for (int which = 0; which < 2 + KINDS; which++) {
        mixture x;
        dist_instance instance;
        mixture_open(&x, which < 3 ? 0 : which - 3, ctx);
        const part *a = &x.w.part[which < 3 ? which : 3];
        memset(&instance, 0, sizeof instance);
        instance.field = &a->field;
        dist_scene *scene = dist_scene_create(ctx, 1, &instance);
        dist_field field = dist_scene_field(scene);
        CHECK_NEAR(a->field.radius, field.radius, 0);
        CHECK_NEAR_ARRAY(3, a->field.center, field.center, 0);
        dist_camera camera = camera_for(&field, SIDE);
        dist_images out = shape_planes(&first), plain = shape_planes(&second);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &a->field, &camera, NULL, &plain, NULL), ctx);
        int differ = compare(&first, &second);
        CHECK(differ <= (which < 3 ? 0 : hits_of(&first) / 300)); /* nets steeper than their figure: grazing rays */
        CHECK(hits_of(&first) > PIXELS / 20);
        int off = 0, near = 0; /* the silhouette is the same where it is below a fifth of the radius */
        for (int i = 0; i < PIXELS; i++) {
            if (second.silhouette[i] > 0.18f * field.radius || first.silhouette[i] > 0.18f * field.radius) continue;
            near++;
            off += fabs((double)first.silhouette[i] - (double)second.silhouette[i]) > 0.005 * (double)field.radius;
        }
        /* the least along a ray is sampled: another of several, far from the outline, most where a net is steep */
        CHECK(off <= near / (which < 3 ? 200 : 50));
        dist_scene_destroy(scene);
        mixture_close(&x);
    }
    dist_context_destroy(ctx);
}

/* The default epsilon and the step of differences go by the smallest instance: a ball a hundredth of the other's size
   is as round as it is alone. */
TEST(a_small_instance_is_as_sharp_as_alone)
{
    dist_context *ctx = test_context();
    const float large[4] = {0, 0, 0, 1}, small[4] = {0, 0, 0, 1};
    dist_field fields[2];
    dist_instance instances[2];
    memset(instances, 0, sizeof instances);
    fields[0] = dist_field_sphere(large);
    fields[1] = dist_field_sphere(small);
    instances[0].field = &fields[0];
    instances[1].field = &fields[1];
    instances[1].placement.scale = 0.01f;
    instances[1].placement.translation[0] = 1.2f;
    dist_scene *scene = dist_scene_create(ctx, 2, instances);
    dist_field field = dist_scene_field(scene);
    float eye[3] = {1.2f, 0, 0.05f}, at[3] = {1.2f, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(SIDE, SIDE, 0.42f, eye, at, up);
    CHECK_NEAR(0.01 * (double)fields[1].radius, field.detail, 1e-8);
    double bounds[3] = {0, 0, 0};
    for (int mode = 0; mode < 3; mode++) { /* the last: as if the defaults went by the scene's radius */
        dist_images out = shape_planes(&first);
        dist_render_desc how;
        int judged = 0, dull = 0, wrong = 0;
        double worst = 0;
        if (mode == 2) field.detail = 0;
        memset(&how, 0, sizeof how);
        how.normal_mode = mode == 1;
        out.error = first_error;
        out.distance = first_distance;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, &how, &out, NULL), ctx);
        for (int i = 0; i < PIXELS; i++) {
            float o[3], d[3];
            dist_camera_ray(&camera, (float)(i % SIDE), (float)(i / SIDE), o, d);
            double c[3], along = 0, square = 0;
            for (int k = 0; k < 3; k++) c[k] = (double)o[k] - (double)instances[1].placement.translation[k];
            for (int k = 0; k < 3; k++) along -= c[k] * (double)d[k];
            for (int k = 0; k < 3; k++) square += (c[k] + along * (double)d[k]) * (c[k] + along * (double)d[k]);
            wrong += square < 0.98e-4 && !first.mask[i];
            if (!first.mask[i] || square > 0.8e-4) continue;
            double t = along - sqrt(1e-4 - square), dot = 0;
            worst = fmax(worst, fabs(t - (double)first_distance[i]) - (double)first_error[i]);
            for (int k = 0; k < 3; k++) {
                double n = 0; /* the normal in camera space */
                for (int l = 0; l < 3; l++)
                    n += (double)camera.rotation[3 * k + l] * (c[l] + t * (double)d[l]) / 0.01;
                dot += n * (double)first.normal[3 * i + k];
            }
            judged++;
            dull += dot < 0.9995;
            bounds[mode] += (double)first_error[i];
        }
        CHECK(judged > PIXELS / 4);
        CHECK_EQUAL(0, wrong);
        CHECK(worst < 1e-6);
        CHECK(dull * 50 <= judged);
        if (test_state.verbose)
            printf("    mode %d: %d judged, %d dull, worst %.1e, mean bound %.1e\n", mode, judged, dull, worst,
                   bounds[mode] / judged);
    }
    CHECK(bounds[0] < 0.5 * bounds[2] && bounds[1] < 0.5 * bounds[2]);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

TEST(a_scene_of_scenes_is_the_flat_scene)
{
    enum { N = 2000 };
    static float points[3 * N], flat[N], nested[N], d_flat[100], d_nested[100];
    dist_context *ctx = test_context();
    mixture x;
    test_random random = test_random_seed(3);
    mixture_open(&x, 0, ctx);
    dist_instance pairs[2][2], both[2];
    dist_scene *scenes[2];
    dist_field fields[2];
    memset(pairs, 0, sizeof pairs);
    memset(both, 0, sizeof both);
    for (int k = 0; k < 4; k++) {
        pairs[k / 2][k % 2].field = &x.w.part[k].field;
        pairs[k / 2][k % 2].placement = x.w.part[k].placement;
    }
    for (int k = 0; k < 2; k++) {
        scenes[k] = dist_scene_create(ctx, 2, pairs[k]);
        fields[k] = dist_scene_field(scenes[k]);
        both[k].field = &fields[k];
    }
    dist_scene *scene = dist_scene_create(ctx, 2, both);
    dist_field field = dist_scene_field(scene);
    near_points(&random, &x.w, N, 0.95, points);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &x.w.field, N, points, flat, NULL), ctx);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, N, points, nested, NULL), ctx);
    double worst = 0;
    int judged = 0, kept = 0;
    for (int i = 0; i < N; i++) {
        if (flat[i] > 0.05f || nested[i] > 0.05f) continue; /* farther off the lower bounds are other spheres' */
        worst = fmax(worst, fabs((double)flat[i] - (double)nested[i]));
        memmove(points + 3 * kept++, points + 3 * i, 3 * sizeof(float));
        judged++;
    }
    CHECK(judged > 100);
    CHECK_NEAR(0, worst, 2e-6);
    dist_gradients grads;
    memset(&grads, 0, sizeof grads);
    memset(d_flat, 0, sizeof d_flat);
    memset(d_nested, 0, sizeof d_nested);
    for (int i = 0; i < kept; i++) flat[i] = 1.0f;
    grads.code = d_flat;
    CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &x.w.field, (size_t)kept, points, flat, NULL, NULL, NULL, &grads),
                 ctx);
    grads.code = d_nested;
    CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &field, (size_t)kept, points, flat, NULL, NULL, NULL, &grads), ctx);
    for (int k = 0; k < 2; k++) {
        int from = dist_scene_offset(x.w.scene, 2 * k), size = dist_scene_offset(x.w.scene, 2 * k + 2) - from;
        CHECK_NEAR_ARRAY((size_t)size, d_flat + from, d_nested + dist_scene_offset(scene, k), 2e-3);
    }
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(scenes[0], 0, &both[0]), ctx); /* itself */
    dist_instance loop = both[0];
    loop.field = &field;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(scenes[0], 0, &loop), ctx); /* itself, by way of another */
    dist_scene_destroy(scene);
    dist_scene_destroy(scenes[0]);
    dist_scene_destroy(scenes[1]);
    mixture_close(&x);
    dist_context_destroy(ctx);
}

/* ---- what it costs ----------------------------------------------------------------------------------------------- */

/* 20 nets on a shelf; gap: between their spheres, in radii. */
static void shelf_open(world *w, mixture *x, dist_context *ctx, float gap)
{
    test_random random = test_random_seed(9);
    memset(w, 0, sizeof *w);
    w->ctx = ctx;
    w->count = 20;
    for (int k = 0; k < w->count; k++) {
        w->part[k] = part_make(ctx, NET, &x->m, x->net, &random);
        float at = (2 + gap) * 0.5f;
        part_place(&w->part[k], 0.5f, &random, at * (float)(k % 5), at * (float)(k / 5 % 2), at * (float)(k / 10));
    }
    world_open(w);
}

TEST(twenty_instances_cost_a_query_no_more_than_one_and_a_fifth)
{
    dist_context *ctx = test_context();
    for (int touching = 0; touching < 2; touching++) {
        mixture x;
        static world w;
        mixture_open(&x, 0, ctx);
        shelf_open(&w, &x, ctx, touching ? 0.0f : 0.3f);
        dist_camera camera = camera_for(&w.field, SIDE);
        dist_images out = shape_planes(&first);
        unsigned long long before = dist_scene_queries(w.scene);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &w.field, &camera, NULL, &out, NULL), ctx);
        double asked = (double)(dist_scene_queries(w.scene) - before), per = asked / (double)first.stats.queries;
        CHECK(hits_of(&first) > PIXELS / 20);
        CHECK(per <= 1.2);
        if (test_state.verbose)
            printf("    %s: %.0f of the nets for %.0f of the scene: %.3f\n", touching ? "touching" : "apart", asked,
                   (double)first.stats.queries, per);
        world_close(&w);
        mixture_close(&x);
    }
    dist_context_destroy(ctx);
}

TEST(a_scene_of_the_dearest_fields_is_not_refused)
{
    dist_context *ctx = test_context();
    float sphere[4] = {0, 0, 0, 1}, point[3] = {0, 0, 0.5f}, sdf = 0;
    dist_field dear = dist_field_sphere(sphere);
    dist_instance instances[2];
    memset(instances, 0, sizeof instances);
    dear.cost = 2e38f;
    instances[0].field = instances[1].field = &dear;
    dist_scene *scene = dist_scene_create(ctx, 2, instances);
    dist_field field = dist_scene_field(scene);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &field, 1, point, &sdf, NULL), ctx);
    CHECK_NEAR(-0.5, sdf, 1e-5);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

TEST(a_scene_has_the_same_bits_for_any_number_of_threads)
{
    enum { N = 2500 };
    static float points[3 * N], sdf[2][N], gradient[2][3 * N], d_code[2][100], seeds[N], weights[2][4096];
    test_random random = test_random_seed(31);
    random_points(&random, N, 2.0, points);
    for (int i = 0; i < N; i++) seeds[i] = test_random_float(&random, -1, 1);
    memset(d_code, 0, sizeof d_code);
    for (int run = 0; run < 2; run++) {
        test_scheduler scheduler = {7, 0};
        dist_context_desc desc = test_context_desc();
        desc.workers = run ? 7 : 1;
        if (run) desc.scheduler = test_scheduler_hook(&scheduler);
        dist_context *ctx = dist_context_create(&desc);
        mixture x;
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        mixture_open(&x, 0, ctx);
        grads.code = d_code[run];
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &x.w.field, N, points, sdf[run], gradient[run]), ctx);
        CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &x.w.field, N, points, seeds, NULL, NULL, NULL, &grads), ctx);
        REQUIRE(x.w.field.weight_count <= 4096);
        grads.code = NULL;
        grads.weights = weights[run];
        CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &x.w.field, N, points, seeds, NULL, NULL, NULL, &grads), ctx);
        mixture_close(&x);
        dist_context_destroy(ctx);
    }
    CHECK_BYTES(sizeof weights[0], weights[0], weights[1]);
    CHECK_BYTES(sizeof sdf[0], sdf[0], sdf[1]);
    CHECK_BYTES(sizeof gradient[0], gradient[0], gradient[1]);
    CHECK_BYTES(sizeof d_code[0], d_code[0], d_code[1]);
}

/* ---- fits -------------------------------------------------------------------------------------------------------- */

typedef struct fit {
    double start, end; /* loss */
    double off[7];     /* the numbers of the placement that are left */
    double code;       /* largest */
} fit;

/* A torus and a box: the torus's placement, and its code as well, from a depth picture and a silhouette. */
static fit fit_torus(dist_context *ctx, int with_code, const float step[7])
{
    enum { W = 40, N = W * W };
    static float depth[N], target[N], silhouette[N], d_depth[N], d_silhouette[N], moments[64], x[32];
    static unsigned char mask[N], outline[N];
    float torus[5] = {0, 0, 0, 0.55f, 0.2f}, box[6] = {0, 0, 0, 0.3f, 0.3f, 0.3f}, truth[5], d_code[32];
    dist_field fields[2] = {dist_field_torus(torus), dist_field_box(box)};
    dist_instance instances[2];
    fit result;
    memset(&result, 0, sizeof result);
    memset(instances, 0, sizeof instances);
    memcpy(truth, torus, sizeof truth);
    for (int k = 0; k < 2; k++) instances[k].field = &fields[k];
    float turned[7] = {0.1f, 0.5f, 0.2f, 0.3f, 0.1f, 0.05f, 0.0f};
    dist_similarity_move(&instances[0].placement, turned);
    instances[1].placement.translation[0] = -1.0f;
    dist_similarity goal = instances[0].placement;
    dist_scene *scene = dist_scene_create(ctx, 2, instances);
    dist_field field = dist_scene_field(scene);
    dist_camera camera = camera_for(&field, W);
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    dist_images out, d_out;
    dist_gradients grads;
    dist_adam adam;
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    memset(&adam, 0, sizeof adam);
    memset(moments, 0, sizeof moments);
    out.depth = target;
    out.mask = outline;
    dist_render(ctx, &field, &camera, NULL, &out, NULL);
    dist_similarity_move(&instances[0].placement, step);
    if (with_code) torus[3] += 0.08f, torus[4] -= 0.05f;
    out.depth = depth;
    out.mask = mask;
    out.silhouette = silhouette;
    d_out.depth = d_depth;
    d_out.silhouette = d_silhouette;
    grads.code = d_code;
    adam.moments = moments;
    int first_number = dist_scene_offset(scene, 0) + 5;
    for (int i = 0; i < 150; i++) {
        adam.rate = 0.02f * powf(0.02f, (float)i / 150.0f);
        memset(d_depth, 0, sizeof d_depth);
        memset(d_silhouette, 0, sizeof d_silhouette);
        memset(d_code, 0, sizeof d_code);
        dist_scene_set(scene, 0, &instances[0]);
        field = dist_scene_field(scene);
        dist_render(ctx, &field, &camera, NULL, &out, tape);
        result.end = (double)dist_loss_depth(N, depth, target, mask, 5.0f, d_depth) +
                     (double)dist_loss_silhouette(N, silhouette, outline, 5.0f, d_silhouette);
        if (i == 0) result.start = result.end;
        CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        memset(x, 0, sizeof x); /* each step begins at the placement that is */
        if (with_code) memcpy(x, torus, sizeof torus);
        dist_adam_step(&adam, 12, x, d_code);
        dist_similarity_move(&instances[0].placement, x + first_number);
        if (with_code) memcpy(torus + 3, x + 3, 2 * sizeof(float));
    }
    const dist_similarity *now = &instances[0].placement;
    double axis = 0; /* a torus does not feel a turn around its own axis */
    for (int i = 0; i < 3; i++) {
        axis += (double)now->rotation[3 * i + 1] * (double)goal.rotation[3 * i + 1];
        result.off[4 + i] = (double)now->translation[i] - (double)goal.translation[i];
    }
    result.off[0] = log((double)now->scale / (double)goal.scale);
    result.off[1] = acos(fmin(1, fabs(axis)));
    for (int i = 3; i < 5; i++) /* in the world: the scale and the radii pull at the same */
        result.code = fmax(result.code, fabs((double)(now->scale * torus[i]) - (double)(goal.scale * truth[i])));
    dist_tape_destroy(tape);
    dist_scene_destroy(scene);
    return result;
}

TEST(a_placement_is_found_from_a_picture_alone_and_with_the_code)
{
    dist_context *ctx = test_context();
    float step[7] = {0.15f, 0.2f, -0.1f, 0.15f, 0.1f, -0.08f, 0.12f};
    for (int with_code = 0; with_code < 2; with_code++) {
        fit f = fit_torus(ctx, with_code, step);
        if (test_state.verbose)
            printf("    loss %.4f -> %.6f, scale %.4f, angle %.4f, translation %.4f %.4f %.4f, radii %.4f\n", f.start,
                   f.end, f.off[0], f.off[1], f.off[4], f.off[5], f.off[6], f.code);
        CHECK(f.end < 0.03 * f.start);
        if (!with_code) CHECK_NEAR(0, f.off[0], 5e-3);
        CHECK_NEAR(0, f.off[1], 2e-2);
        for (int i = 4; i < 7; i++) CHECK_NEAR(0, f.off[i], 5e-3);
        CHECK_NEAR(0, f.code, 5e-3);
    }
    dist_context_destroy(ctx);
}

/* A picture's gradient goes to the instance that is seen; moving it is moving the camera the other way. */
TEST(a_pixel_pulls_on_the_instance_that_it_shows_alone)
{
    enum { W = 48, N = W * W };
    static float depth[N], d_depth[N];
    static unsigned char mask[N];
    dist_context *ctx = test_context();
    float ball[4] = {0, 0, 0, 0.5f}, box[6] = {0, 0, 0, 0.4f, 0.3f, 0.5f}, d_code[24], d_translation[3];
    dist_field fields[2] = {dist_field_sphere(ball), dist_field_box(box)};
    dist_instance two[2];
    memset(two, 0, sizeof two);
    for (int k = 0; k < 2; k++) {
        float move[7] = {0.1f, 0.3f, -0.2f, 0.4f, k ? 0.8f : -0.8f, 0, 0};
        two[k].field = &fields[k];
        dist_similarity_move(&two[k].placement, move);
    }
    dist_scene *scene = dist_scene_create(ctx, 2, two);
    dist_field field = dist_scene_field(scene);
    dist_camera camera = camera_for(&field, W);
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    dist_images out, d_out;
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    out.depth = depth;
    out.mask = mask;
    d_out.depth = d_depth;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape), ctx);
    for (int shown = 0; shown < 2; shown++) {
        dist_gradients grads;
        int count = 0;
        memset(&grads, 0, sizeof grads);
        memset(d_code, 0, sizeof d_code);
        memset(d_translation, 0, sizeof d_translation);
        grads.code = d_code;
        grads.translation = d_translation;
        for (int i = 0; i < N; i++) {
            float o[3], d[3], p[3];
            int index = -1;
            d_depth[i] = 0;
            if (!mask[i]) continue;
            dist_camera_ray(&camera, (float)(i % W), (float)(i / W), o, d);
            float along = camera.rotation[6] * d[0] + camera.rotation[7] * d[1] + camera.rotation[8] * d[2];
            for (int k = 0; k < 3; k++) p[k] = o[k] + depth[i] / along * d[k];
            CHECK_STATUS(DIST_OK, dist_scene_find(scene, 1, p, &index), ctx);
            if (index != shown) continue;
            d_depth[i] = 1.0f;
            count++;
        }
        CHECK(count > 20);
        CHECK_STATUS(DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
        int end[3] = {0, dist_scene_offset(scene, 1), dist_scene_offset(scene, 2)};
        double there = 0, turned[3] = {0, 0, 0};
        for (int j = 0; j < end[2]; j++) {
            int mine = j >= end[shown] && j < end[shown + 1];
            if (!mine) CHECK_NEAR(0, d_code[j], 0);
            else there = fmax(there, fabs((double)d_code[j]));
        }
        CHECK(there > 1);
        for (int i = 0; i < 3; i++) /* x_cam = R x + t: an instance moved by R^T dt is the camera's t moved by dt */
            for (int k = 0; k < 3; k++)
                turned[i] += (double)camera.rotation[3 * i + k] * (double)d_code[end[shown + 1] - 3 + k];
        turned[0] -= (double)d_translation[0];
        turned[1] -= (double)d_translation[1];
        turned[2] -= (double)d_translation[2];
        for (int i = 0; i < 3; i++) CHECK_NEAR(0, turned[i], 1e-3 * count);
    }
    dist_tape_destroy(tape);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

/* ---- the door ---------------------------------------------------------------------------------------------------- */

TEST(moving_a_placement_keeps_it_a_similarity)
{
    dist_similarity s;
    test_random random = test_random_seed(2);
    memset(&s, 0, sizeof s);
    double logarithm = 0;
    for (int i = 0; i < 500; i++) {
        float step[7];
        test_random_fill(&random, 7, step, -1, 1);
        logarithm += (double)step[0];
        dist_similarity_move(&s, step);
    }
    double m[9], determinant;
    for (int i = 0; i < 9; i++) m[i] = (double)s.rotation[i];
    CHECK_NEAR(0, inside_rotation_off(m, &determinant), 1e-6);
    CHECK_NEAR(1, determinant, 1e-6);
    CHECK_NEAR(1, (double)s.scale / exp(logarithm), 1e-4);
    float step[7] = {0};
    memset(&s, 0, sizeof s);
    dist_similarity_move(&s, step);
    CHECK_NEAR(1, s.scale, 0);
    CHECK_NEAR(1, s.rotation[4], 0);
    dist_similarity_move(NULL, step);
    dist_similarity_move(&s, NULL);
    for (int k = 0; k < 7; k++) { /* what is not finite moves nothing, the rest of the step neither */
        dist_similarity before = s;
        float wrong[7] = {0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.1f, 0.1f};
        wrong[k] = k & 1 ? INFINITY : NAN;
        dist_similarity_move(&s, wrong);
        CHECK(memcmp(&before, &s, sizeof s) == 0);
    }
    for (int k = 0; k < 3; k++) { /* never 0, which would mean 1 */
        float far[7] = {k == 1 ? 1000.0f : -1000.0f, 0, 0, 0, 0, 0, 0};
        dist_similarity_move(&s, far);
        CHECK(s.scale > 0 && test_finite((double)s.scale));
    }
    s.scale = 1e-30f; /* e^100 alone is more than a float holds */
    step[0] = 100.0f;
    dist_similarity_move(&s, step);
    CHECK_NEAR(1, (double)s.scale / (1e-30 * exp(100.0)), 1e-6);
    s.scale = 1e30f;
    step[0] = -110.0f;
    dist_similarity_move(&s, step);
    CHECK_NEAR(1, (double)s.scale / (1e30 * exp(-110.0)), 1e-6);
    for (int k = 0; k < 3; k++) { /* nor beyond float's range */
        float far[7] = {1e30f, 0, 0, 0, 2e38f, -2e38f, 0};
        dist_similarity_move(&s, far);
        CHECK(test_finite((double)s.scale) && test_finite((double)s.translation[0]));
        CHECK(test_finite((double)s.translation[1]) && s.translation[1] < 0);
    }
    s.scale = -2.0f; /* no placement: it does not become one */
    dist_similarity_move(&s, step);
    CHECK_NEAR(-2, (double)s.scale, 0);
}

static int refused(dist_context *ctx, const dist_instance *instance, const char *sentence)
{
    dist_scene *scene = dist_scene_create(ctx, 1, instance);
    int good = CHECK(scene == NULL) & CHECK_TEXT(sentence, dist_context_message(ctx));
    dist_scene_destroy(scene);
    dist_context_clear(ctx);
    return good;
}

/* A box with two half extents below 0 was the outside of nothing, a ring thinner than none a smaller ring. */
TEST(sizes_below_zero_are_refused_and_a_plate_of_no_thickness_is_not)
{
    dist_context *ctx = test_context();
    const float sphere[4] = {0, 0, 0, -1}, torus[5] = {0, 0, 0, 0.5f, -0.1f}, box[6] = {0, 0, 0, 0.5f, -0.3f, 0.4f};
    const float none[4] = {0, 0, 0, NAN}, plate[6] = {0, 0, 0, 0.5f, 0, 0.5f}, p[3] = {0, 0.25f, 0};
    dist_field wrong[4];
    float f = 0;
    wrong[0] = dist_field_sphere(sphere);
    wrong[1] = dist_field_torus(torus);
    wrong[2] = dist_field_box(box);
    wrong[3] = dist_field_sphere(none);
    for (int i = 0; i < 4; i++) {
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_eval(ctx, &wrong[i], 1, p, &f, NULL), ctx);
        if (i == 2) CHECK_TEXT("field.radius is -0.3, must be", dist_context_message(ctx));
        dist_context_clear(ctx);
    }
    dist_field right = dist_field_box(plate);
    CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &right, 1, p, &f, NULL), ctx);
    CHECK_NEAR(0.25, f, 1e-6);
    dist_context_destroy(ctx);
}

/* Squares of such lengths do not fit a float: a sphere of 1e-20 rendered as nothing at all, without a word. */
TEST(radii_that_floats_cannot_square_are_refused)
{
    dist_context *ctx = test_context();
    const float radii[7] = {1e-30f, 1e-20f, 0.5e-15f, 2e-15f, 5e14f, 1e20f, 1e30f};
    for (int i = 0; i < 7; i++) {
        float sphere[4] = {0, 0, 0, radii[i]}, one[4] = {0, 0, 0, 1.0f}, eye[3] = {0, 0, 2.5f * radii[i]}, depth = 0;
        dist_field field = dist_field_sphere(sphere), unit = dist_field_sphere(one);
        dist_camera camera = dist_camera_look_at(1, 1, 0.01f, eye, NULL, NULL);
        dist_instance instance;
        dist_images out;
        memset(&instance, 0, sizeof instance);
        memset(&out, 0, sizeof out);
        out.depth = &depth;
        instance.field = &unit;
        instance.placement.scale = radii[i];
        if (i < 3 || i > 4) {
            CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
            refused(ctx, &instance, "must be 1e-15 to 1e15");
            continue;
        }
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        CHECK_NEAR(1.5, (double)depth / (double)radii[i], 1e-3);
        dist_scene *scene = dist_scene_create(ctx, 1, &instance);
        field = dist_scene_field(scene);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, NULL), ctx);
        CHECK_NEAR(1.5, (double)depth / (double)radii[i], 1e-3);
        dist_scene_destroy(scene);
    }
    float one[4] = {0, 0, 0, 1.0f};
    dist_field field = dist_field_sphere(one);
    dist_instance instance;
    memset(&instance, 0, sizeof instance);
    instance.field = &field;
    field.color_code_size = -1;
    refused(ctx, &instance, "field.color_code_size is -1, must be 0 or more, below 3e38");
    dist_context_destroy(ctx);
}

TEST(scenes_refuse_what_cannot_be_placed)
{
    dist_context *ctx = test_context(), *other = test_context();
    float sphere[4] = {0, 0, 0, 1}, torus[5] = {0, 0, 0, 0.5f, 0.2f};
    dist_field field = dist_field_sphere(sphere), bad = field, ring = dist_field_torus(torus);
    dist_instance good, x;
    memset(&good, 0, sizeof good);
    good.field = &field;
    CHECK(dist_scene_create(NULL, 1, &good) == NULL);
    CHECK(dist_scene_create(ctx, 0, NULL) == NULL);
    CHECK_TEXT("count is 0, must be 1 to", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(dist_scene_create(ctx, 1, NULL) == NULL);
    CHECK_TEXT("instances is NULL", dist_context_message(ctx));
    dist_context_clear(ctx);
    x = good;
    x.field = NULL;
    refused(ctx, &x, "field is NULL");
    bad.eval_fn = NULL;
    x.field = &bad;
    refused(ctx, &x, "eval_fn is NULL");
    bad = field;
    bad.owner = other;
    refused(ctx, &x, "another context");
    static const struct {
        float scale, first, second;
        const char *sentence;
    } cases[] = {{-1, 0, 0, "scale is -1"}, {1, 2, 0, "not a rotation"}, {1, 1, 0, "not a rotation"},
                 {1e38f, 0, 3e38f, "bounding sphere's radius is "}};
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        x = good;
        x.placement.scale = cases[i].scale;
        x.placement.rotation[0] = cases[i].first;
        x.placement.translation[0] = cases[i].second;
        if (i == 3) bad = field, bad.radius = 100, x.field = &bad;
        refused(ctx, &x, cases[i].sentence);
    }
    x = good;
    x.placement.rotation[0] = x.placement.rotation[4] = 1;
    x.placement.rotation[8] = -1; /* a mirror */
    refused(ctx, &x, "determinant -1");
    static const char *const numbers[3] = {"placement.scale is", "placement.rotation is", "placement.translation is"};
    for (int i = 0; i < 6; i++) {
        const uint32_t bits[2] = {0x7fc00000u, 0x7f800000u};
        x = good;
        float *const places[3] = {&x.placement.scale, &x.placement.rotation[3], &x.placement.translation[1]};
        memcpy(places[i / 2], &bits[i % 2], sizeof bits[0]);
        refused(ctx, &x, numbers[i / 2]);
    }
    x = good;
    x.placement.translation[1] = -1e30f;
    refused(ctx, &x, "at -1e30 on axis 1; must be within 1e15");
    dist_instance many[3] = {good, good, good}; /* which one is refused */
    many[2].placement.scale = -1;
    CHECK(dist_scene_create(ctx, 3, many) == NULL);
    CHECK_TEXT("placement.scale is -1, must be above 0 (0: 1) (instances[2])", dist_context_message(ctx));
    dist_context_clear(ctx);
    many[0].field = NULL;
    CHECK(dist_scene_create(ctx, 3, many) == NULL);
    CHECK_TEXT("(instances[0])", dist_context_message(ctx));
    dist_context_clear(ctx);
    CHECK(dist_scene_create(ctx, 0, many) == NULL);
    CHECK(!strstr(dist_context_message(ctx), "instances["));
    dist_context_clear(ctx);
    dist_scene *scene = dist_scene_create(ctx, 1, &good);
    REQUIRE(scene != NULL);
    x = good;
    x.field = &ring; /* five numbers in place of four */
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(scene, 0, &x), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(scene, 1, &good), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(scene, -1, &good), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(scene, 0, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(NULL, 0, &good), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_find(scene, 1, NULL, NULL), ctx);
    x.field = NULL; /* stays */
    x.placement.translation[2] = 3;
    CHECK_STATUS(DIST_OK, dist_scene_set(scene, 0, &x), ctx);
    CHECK_NEAR(3, dist_scene_field(scene).center[2], 0);
    CHECK_EQUAL(-1, dist_scene_offset(scene, 2));
    CHECK_EQUAL(-1, dist_scene_offset(NULL, 0));
    CHECK_EQUAL(11, dist_scene_offset(scene, 1));
    CHECK(dist_scene_field(NULL).eval_fn == NULL);
    CHECK_EQUAL(0, dist_scene_queries(NULL));
    dist_scene_destroy(scene);
    dist_scene_destroy(NULL);
    dist_context_destroy(ctx);
    dist_context_destroy(other);
}

/* NaN of a field, and points that are not finite, come out as such. */
static void poison_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    uint32_t bits = 0x7fc00000u;
    (void)user;
    (void)worker;
    (void)points;
    for (size_t i = 0; i < n; i++) memcpy(sdf + i, &bits, sizeof bits);
    if (gradient) memset(gradient, 0, 3 * n * sizeof(float));
}

/* A shape's or a scene's field with another function and user, in memory of their own size; the rest is theirs. */
static void wrapped_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const dist_field *field = *(dist_field *const *)user;
    field->eval_fn(field->user, worker, n, points, sdf, gradient);
}

/* A field taken before an instance left its sphere, a shape whose net, or whose texture, has got other weights since
   it was set, and a tape of what is no longer so are refused, wherever they are used; as soon as all is what it was, or
   set anew, nothing is. */
TEST(what_is_older_than_what_it_goes_by_is_refused)
{
    enum { SMALL = 16, N = SMALL * SMALL };
    static float original[2][20000], other[2][20000], depth[N], ones[N], d_code[64];
    const char *const left = "take dist_scene_field again", *const folded = "have changed since dist_shape_set_code";
    dist_context *ctx = test_context();
    dist_net_desc desc;
    memset(&desc, 0, sizeof desc);
    desc.layers = 4;
    desc.width = 32;
    desc.code_size = 3;
    desc.geometric = 1;
    desc.clamp = -1;
    dist_net *net = dist_net_create(ctx, &desc);
    desc.geometric = 0;
    desc.color = 1;
    dist_net *paint = dist_net_create(ctx, &desc);
    dist_shape *shape = dist_shape_create(ctx, net, NULL);
    REQUIRE(net && paint && shape && dist_net_weight_count(net) <= 20000 && dist_net_weight_count(paint) <= 20000);
    CHECK_STATUS(DIST_OK, dist_shape_set_texture(shape, paint, NULL), ctx);
    dist_field field = dist_shape_field(shape);
    CHECK_NEAR(0, field.clamp, 0); /* there is a code, but none was wanted */
    dist_instance one[2];
    memset(one, 0, sizeof one);
    one[0].field = one[1].field = &field;
    one[1].placement.translation[0] = 1.5f;
    dist_scene *scene = dist_scene_create(ctx, 2, one), *outer = NULL;
    dist_field all = dist_scene_field(scene), taken = all, around;
    one[0].field = &all;
    outer = dist_scene_create(ctx, 1, one);
    around = dist_scene_field(outer);
    dist_field *fields[3] = {&field, &all, &around};
    dist_camera camera = shape_camera(SMALL, SMALL);
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    dist_images out, d_out;
    dist_gradients grads;
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    out.depth = depth;
    d_out.depth = ones;
    grads.code = d_code;
    REQUIRE(tape && outer && around.code_size <= 64);
    for (int i = 0; i < N; i++) ones[i] = 1;
    for (int k = 0; k < 2; k++)
        for (size_t i = 0; i < dist_net_weight_count(k ? paint : net); i++) {
            original[k][i] = dist_net_weights(k ? paint : net)[i];
            other[k][i] = 1.01f * original[k][i];
        }

    one[1].placement.translation[0] = 3; /* out of the sphere, and back into it */
    CHECK_STATUS(DIST_OK, dist_scene_set(scene, 1, &one[1]), ctx);
    for (int k = 1; k < 3; k++) {
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, fields[k], &camera, NULL, &out, NULL), ctx);
        CHECK_TEXT(left, dist_context_message(ctx));
        dist_context_clear(ctx);
        CHECK_STATUS(DIST_BAD_ARGUMENT, dist_field_eval(ctx, fields[k], 1, ones, depth, NULL), ctx);
        dist_context_clear(ctx);
    }
    all.radius = around.radius = 10; /* one's own, with room for it; but the scene around has the inner one's */
    CHECK_STATUS(DIST_OK, dist_render(ctx, &all, &camera, NULL, &out, NULL), ctx);
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_render(ctx, &around, &camera, NULL, &out, NULL), ctx);
    dist_context_clear(ctx);
    all = taken;
    one[1].placement.translation[0] = 1.2f;
    CHECK_STATUS(DIST_OK, dist_scene_set(scene, 1, &one[1]), ctx);
    CHECK_STATUS(DIST_OK, dist_render(ctx, &around, &camera, NULL, &out, NULL), ctx);

    for (int k = 0; k < 3; k++) { /* what a wrapped one's user is, nobody knows */
        dist_field wrapped = *fields[k], **user = (dist_field **)malloc(sizeof *user);
        REQUIRE(user != NULL);
        *user = fields[k];
        wrapped.user = user;
        wrapped.eval_fn = wrapped_eval;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &wrapped, &camera, NULL, &out, NULL), ctx);
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &wrapped, 1, ones, depth, NULL), ctx);
        free(user);
    }
    const float code[3] = {0.1f, 0.2f, -0.1f};
    for (int k = 0; k < 3; k++) { /* a tape of another code, of other weights, of another place; and back */
        CHECK_STATUS(DIST_OK, dist_render(ctx, fields[k], &camera, NULL, &out, tape), ctx);
        for (int what = 0; what < (k ? 3 : 2); what++)
            for (int on = 1; on >= 0; on--) {
                one[1].placement.translation[0] = on ? 1.1f : 1.2f;
                if (what == 0) CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, on ? code : NULL), ctx);
                if (what == 1) CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, (on ? other : original)[0]), ctx);
                if (what == 1) CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
                if (what == 2) CHECK_STATUS(DIST_OK, dist_scene_set(scene, 1, &one[1]), ctx);
                dist_status status = dist_render_backward(ctx, tape, &d_out, &grads);
                CHECK_STATUS(on ? DIST_BAD_ARGUMENT : DIST_OK, status, ctx);
                if (on) CHECK_TEXT("are not what they were in dist_render", dist_context_message(ctx));
                dist_context_clear(ctx);
            }
    }
    for (int k = 0; k < 3; k++) {
        for (int on = 1; on >= 0; on--) { /* f, and with it all */
            CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, net, (on ? other : original)[0]), ctx);
            dist_status status = dist_render(ctx, fields[k], &camera, NULL, &out, NULL);
            CHECK_STATUS(on ? DIST_BAD_ARGUMENT : DIST_OK, status, ctx);
            if (on) CHECK_TEXT(folded, dist_context_message(ctx));
            dist_context_clear(ctx);
            int index[2];
            for (int scenes = 0; scenes < 3; scenes++) {
                if (scenes == 0) status = dist_shape_eval(ctx, shape, 1, ones, depth);
                else status = dist_scene_find(scenes == 1 ? scene : outer, 1, ones, index);
                CHECK_STATUS(on ? DIST_BAD_ARGUMENT : DIST_OK, status, ctx);
                if (on) CHECK_TEXT(folded, dist_context_message(ctx));
                dist_context_clear(ctx);
            }
        }
        for (int on = 1; on >= 0; on--) { /* color alone */
            CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, paint, other[1]), ctx);
            if (!on) CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
            CHECK_STATUS(DIST_OK, dist_render(ctx, fields[k], &camera, NULL, &out, NULL), ctx);
            dist_status status = dist_color_eval(ctx, fields[k], 1, ones, d_code);
            CHECK_STATUS(on ? DIST_BAD_ARGUMENT : DIST_OK, status, ctx);
            if (on) CHECK_TEXT(folded, dist_context_message(ctx));
            dist_context_clear(ctx);
        }
        CHECK_STATUS(DIST_OK, dist_net_set_weights(ctx, paint, original[1]), ctx);
        CHECK_STATUS(DIST_OK, dist_shape_set_code(shape, NULL), ctx);
    }
    dist_tape_destroy(tape);
    dist_scene_destroy(outer);
    dist_scene_destroy(scene);
    dist_shape_destroy(shape);
    dist_net_destroy(paint);
    dist_net_destroy(net);
    dist_context_destroy(ctx);
}

/* The numbers of an analytic field are its code: a tape and a cache of others are refused, until they are back. */
TEST(analytic_fields_whose_numbers_have_changed_are_refused)
{
    enum { SMALL = 8, N = SMALL * SMALL };
    float c[6] = {0.1f, -0.1f, 0, 0.3f, 0.2f, 0.25f}, depth[N], ones[N], d_code[6] = {0}, sdf;
    dist_context *ctx = test_context();
    dist_camera camera = shape_camera(SMALL, SMALL);
    dist_tape *tape = dist_tape_create(ctx, &camera, NULL);
    dist_images out, d_out;
    dist_gradients grads;
    memset(&out, 0, sizeof out);
    memset(&d_out, 0, sizeof d_out);
    memset(&grads, 0, sizeof grads);
    out.depth = depth;
    d_out.depth = ones;
    grads.code = d_code;
    for (int i = 0; i < N; i++) ones[i] = 1;
    for (int k = 0; k < 3; k++) {
        dist_field field = k == 0 ? dist_field_sphere(c) : k == 1 ? dist_field_torus(c) : dist_field_box(c);
        dist_cache *cache = dist_cache_create(ctx, &field, 16);
        dist_field cached = dist_cache_field(cache);
        CHECK_STATUS(DIST_OK, dist_render(ctx, &field, &camera, NULL, &out, tape), ctx);
        for (int i = 0; i < field.code_size; i++)
            for (int on = 1; on >= 0; on--) {
                c[i] += on ? 0.01f : 0;
                CHECK_STATUS(on ? DIST_BAD_ARGUMENT : DIST_OK, dist_render_backward(ctx, tape, &d_out, &grads), ctx);
                if (on) CHECK_TEXT("are not what they were in dist_render", dist_context_message(ctx));
                dist_context_clear(ctx);
                CHECK_STATUS(on ? DIST_BAD_ARGUMENT : DIST_OK, dist_field_eval(ctx, &cached, 1, ones, &sdf, NULL), ctx);
                dist_context_clear(ctx);
                const float was[6] = {0.1f, -0.1f, 0, 0.3f, 0.2f, 0.25f};
                memcpy(c, was, sizeof c);
            }
        dist_field own = field; /* what user points to is not looked at once eval_fn is another */
        own.user = NULL;
        own.eval_fn = poison_eval;
        own.adjoint_fn = NULL;
        CHECK_STATUS(DIST_OK, dist_render(ctx, &own, &camera, NULL, &out, tape), ctx);
        dist_cache_destroy(cache);
    }
    dist_tape_destroy(tape);
    dist_context_destroy(ctx);
}

TEST(what_is_not_finite_stays_so)
{
    dist_context *ctx = test_context();
    float sphere[4] = {0, 0, 0, 0.5f};
    dist_field field = dist_field_sphere(sphere), poison = field;
    dist_instance two[2];
    uint32_t infinity = 0x7f800000u, nan = 0x7fc00000u;
    poison.eval_fn = poison_eval;
    memset(two, 0, sizeof two);
    two[0].field = &field;
    two[1].field = &poison;
    two[1].placement.translation[0] = 2;
    dist_scene *scene = dist_scene_create(ctx, 2, two);
    dist_field all = dist_scene_field(scene);
    float points[12] = {0, 0, 0, 2, 0, 0, 1, 1, 1, 1, 1, 1}, sdf[4], gradient[12];
    memcpy(points + 7, &nan, sizeof nan);
    memcpy(points + 11, &infinity, sizeof infinity);
    for (int with = 0; with < 2; with++) {
        CHECK_STATUS(DIST_OK, dist_field_eval(ctx, &all, 4, points, sdf, with ? gradient : NULL), ctx);
        CHECK_NEAR(-0.5, sdf[0], 1e-6);
        for (int i = 1; i < 4; i++) CHECK(!test_finite((double)sdf[i]));
    }
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

static void place_color(void *user, int worker, size_t n, const float *points, float *color)
{
    (void)user, (void)worker;
    memcpy(color, points, 3 * n * sizeof(float));
}

static void place_color_adjoint(void *user, int worker, size_t n, const float *points, const float *d_color,
                                float *d_points, double *d_code, double *d_color_code)
{
    (void)user, (void)worker, (void)points, (void)d_code, (void)d_color_code;
    for (size_t i = 0; d_points && i < 3 * n; i++) d_points[i] += d_color[i];
}

TEST(what_is_not_finite_takes_nothing_from_a_placement)
{
    enum { CODE = 13 }; /* a box's six numbers and seven */
    dist_context *ctx = test_context();
    const float box[6] = {0, 0, 0, 0.5f, 0.3f, 0.4f}, bad[3] = {(float)NAN, (float)INFINITY, 0};
    dist_field field = dist_field_box(box), all;
    dist_instance one;
    memset(&one, 0, sizeof one);
    field.color_fn = place_color;
    field.color_adjoint_fn = place_color_adjoint;
    one.field = &field;
    dist_scene *scene = dist_scene_create(ctx, 1, &one);
    all = dist_scene_field(scene);
    REQUIRE(scene != NULL && all.code_size == CODE);
    for (int k = 0; k < 8; k++) { /* a point, or its weight, that is not finite; f's gradient, the color's */
        int color = k & 1, seed = k & 2;
        float points[6] = {0.7f, 0.2f, 0.1f, 0.1f, 0.6f, 0.2f}, weight[6] = {1, 2, 3, 1, 2, 3};
        float d_points[2][6] = {{0}}, code[2][CODE] = {{0}};
        for (int n = 1; n <= 2; n++) {
            dist_gradients grads;
            memset(&grads, 0, sizeof grads);
            grads.code = code[n - 1];
            if (n == 2 && seed) weight[color ? 3 : 1] = bad[k / 4];
            if (n == 2 && !seed) points[3] = bad[k / 4];
            dist_status status =
                color ? dist_color_backward(ctx, &all, (size_t)n, points, weight, NULL, &grads)
                      : dist_field_backward(ctx, &all, (size_t)n, points, weight, NULL, NULL, d_points[n - 1], &grads);
            CHECK_STATUS(DIST_OK, status, ctx);
        }
        for (int i = 0; i < CODE; i++) CHECK_NEAR(code[0][i], code[1][i], 0);
        for (int i = 0; i < 6; i++) CHECK_NEAR(d_points[0][i], d_points[1][i], 0);
        CHECK(code[0][CODE - 3] != 0 && code[0][6] != 0);
        memset(d_points, 0, sizeof d_points);
        dist_gradients none;
        memset(&none, 0, sizeof none);
        if (seed || color) continue;
        CHECK_STATUS(DIST_OK, dist_field_backward(ctx, &field, 2, points, weight, NULL, NULL, d_points[0], &none), ctx);
        CHECK(d_points[0][0] != 0 && d_points[0][3] == 0 && d_points[0][4] == 0 && d_points[0][5] == 0);
    }
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

TEST(colors_are_those_of_the_instance_that_is_hit)
{
    enum { N = 200 };
    static float points[3 * N], color[3 * N], expected[3 * N];
    static const model_desc colored = {.name = "colored", .code_size = 2, .channels = "sdf,r,g,b", .clamp = 0.3};
    dist_context *ctx = test_context();
    model m = model_make(&colored, 4);
    dist_net *net = model_load(ctx, &m);
    float codes[2][2] = {{0.5f, -0.5f}, {-0.4f, 0.3f}};
    dist_shape *shapes[2];
    dist_field fields[2];
    dist_instance two[2];
    test_random random = test_random_seed(6);
    memset(two, 0, sizeof two);
    for (int k = 0; k < 2; k++) {
        shapes[k] = dist_shape_create(ctx, net, codes[k]);
        fields[k] = dist_shape_field(shapes[k]);
        two[k].field = &fields[k];
        two[k].placement.translation[0] = 3.0f * (float)k;
        two[k].placement.scale = 0.5f;
    }
    dist_scene *scene = dist_scene_create(ctx, 2, two);
    dist_field all = dist_scene_field(scene);
    REQUIRE(all.color_fn != NULL);
    for (int i = 0; i < N; i++) {
        float p[3];
        test_random_fill(&random, 3, p, -0.25f, 0.25f);
        int k = i % 2;
        fields[k].color_fn(fields[k].user, 0, 1, p, expected + 3 * i);
        for (int axis = 0; axis < 3; axis++) points[3 * i + axis] = 0.5f * p[axis] + (axis == 0 ? 3.0f * (float)k : 0);
    }
    all.color_fn(all.user, 0, N, points, color);
    CHECK_NEAR_ARRAY(3 * N, expected, color, 2e-6);
    float far[2][3] = {{-40, 3, 0}, {50, 0, 2}}, nearest[6]; /* outside of both: the nearer one's, on its sphere */
    for (int k = 0; k < 2; k++) {
        float p[3] = {far[k][0] - 3.0f * (float)k, far[k][1], far[k][2]};
        float share = fields[k].radius / (float)shape_length((double)p[0], (double)p[1], (double)p[2]);
        for (int axis = 0; axis < 3; axis++) p[axis] *= share; /* its center is 0 */
        fields[k].color_fn(fields[k].user, 0, 1, p, nearest + 3 * k);
    }
    CHECK_STATUS(DIST_OK, dist_color_eval(ctx, &all, 2, far[0], color), ctx);
    CHECK_NEAR_ARRAY(6, nearest, color, 2e-6);
    float sphere[4] = {0, 0, 0, 0.5f};
    dist_field plain = dist_field_sphere(sphere), bare = fields[1];
    bare.color_fn = NULL;
    two[1].field = &bare;
    CHECK_STATUS(DIST_BAD_ARGUMENT, dist_scene_set(scene, 1, &two[1]), ctx);
    CHECK_TEXT("what the instance has of color must stay what it was", dist_context_message(ctx));
    dist_context_clear(ctx);
    two[1].field = &plain;
    dist_scene *mixed = dist_scene_create(ctx, 2, two);
    CHECK(dist_scene_field(mixed).color_fn == NULL);
    dist_scene_destroy(mixed);
    dist_scene_destroy(scene);
    for (int k = 0; k < 2; k++) dist_shape_destroy(shapes[k]);
    dist_net_destroy(net);
    model_free(&m);
    dist_context_destroy(ctx);
}

/* The color is the place that is asked for. Outside of the sphere that is c + r n, n = (p - c) / |p - c|, so that d . c
   has the gradient r / |p - c| (d - n (n . d)): nothing along n. */
TEST(colors_outside_of_the_sphere_move_as_its_nearest_point_does)
{
    float ball[4] = {0, 0, 0, 0.5f}, at[2][3] = {{1.9f, 0.3f, -0.4f}, {0.7f, 0.1f, 0.2f}}, d[3] = {0.3f, -1, 0.6f};
    dist_context *ctx = test_context();
    dist_field field = dist_field_sphere(ball);
    dist_instance instance;
    memset(&instance, 0, sizeof instance);
    field.color_fn = place_color;
    field.color_adjoint_fn = place_color_adjoint;
    instance.field = &field;
    instance.placement.scale = 2.0f;
    instance.placement.translation[0] = 0.25f;
    dist_scene *scene = dist_scene_create(ctx, 1, &instance);
    dist_field all = dist_scene_field(scene);
    double radius = 2 * (double)field.radius;
    for (int k = 0; k < 2; k++) { /* outside, inside */
        float code[11], d_point[3] = {0, 0, 0};
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        memset(code, 0, sizeof code);
        grads.code = code;
        CHECK_STATUS(DIST_OK, dist_color_backward(ctx, &all, 1, at[k], d, d_point, &grads), ctx);
        double n[3] = {(double)at[k][0] - 0.25, (double)at[k][1], (double)at[k][2]}, along = 0, scaled = 0;
        double away = shape_length(n[0], n[1], n[2]), share = k == 0 ? radius / away : 1;
        CHECK((away > radius) == (k == 0));
        for (int i = 0; i < 3; i++) along += n[i] / away * (double)d[i];
        for (int i = 0; i < 3; i++) {
            double expected = 0.5 * share * ((double)d[i] - (k == 0 ? along * n[i] / away : 0));
            CHECK_NEAR(expected, (double)d_point[i], 1e-6);
            CHECK_NEAR(-expected, (double)code[4 + 4 + i], 1e-6); /* the placement's translation */
            scaled -= expected * n[i];
        }
        CHECK_NEAR(scaled, (double)code[4], 1e-6);
    }
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

/* A wire: |grad f| is 1 up to .05 from it and 3 beyond, as its figures say. */
static void wire_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    (void)user, (void)worker;
    for (size_t i = 0; i < n; i++, points += 3) {
        float x = points[0] < -0.7f ? points[0] + 0.7f : points[0] > 0.7f ? points[0] - 0.7f : 0;
        float length = (float)shape_length((double)x, (double)points[1], (double)points[2]), d = length - 4e-3f;
        float slope = d > 0.05f ? 3.0f : 1.0f, axis[3] = {x, points[1], points[2]};
        sdf[i] = d > 0.05f ? 0.05f + 3.0f * (d - 0.05f) : d;
        for (size_t k = 0; gradient && k < 3; k++) gradient[3 * i + k] = length > 0 ? slope * axis[k] / length : 0;
    }
}

/* A scene is larger than its instances: what is near its surface must not be what is a share of its own radius. */
TEST(the_figures_of_an_instance_hold_no_farther_out_in_a_large_scene)
{
    enum { N = 1000 };
    static float from[3 * N], to[3 * N];
    static dist_hit hits[N];
    float ball[4] = {0, 0, 0, 0.3f};
    dist_context *ctx = test_context();
    dist_field wire, sphere = dist_field_sphere(ball);
    test_random random = test_random_seed(7);
    memset(&wire, 0, sizeof wire);
    wire.eval_fn = wire_eval;
    wire.radius = wire.lipschitz = 1;
    wire.lipschitz_far = 3;
    for (int i = 0; i < N; i++) {
        float p[3] = {test_random_float(&random, -0.6f, 0.6f), 0.8f, test_random_float(&random, -0.5f, 0.5f)};
        float q[3] = {test_random_float(&random, -0.6f, 0.6f), test_random_float(&random, -2e-3f, 2e-3f),
                      test_random_float(&random, -2e-3f, 2e-3f)};
        for (int k = 0; k < 3; k++) from[3 * i + k] = p[k], to[3 * i + k] = q[k] - p[k];
    }
    for (int k = 0; k < 6; k++) {
        dist_instance two[2];
        dist_render_desc how;
        int found = 0;
        memset(&how, 0, sizeof how);
        memset(two, 0, sizeof two);
        how.certified = k & 1;
        two[0].field = &wire;
        two[1].field = &sphere;
        two[1].placement.translation[2] = k < 2 ? -2.0f : k < 4 ? -8.0f : -20.0f;
        sphere.clamp = k < 4 ? 0.0f : 3.0f;
        dist_scene *scene = dist_scene_create(ctx, 2, two);
        dist_field all = dist_scene_field(scene);
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &all, N, from, to, &how, hits, NULL), ctx);
        for (int i = 0; i < N; i++) found += hits[i].status == DIST_RAY_HIT;
        CHECK_EQUAL(N, found);
        dist_scene_destroy(scene);
    }
    dist_context_destroy(ctx);
}

/* A thin shell of radius .9 around a ball, with |grad f| the number that user points to everywhere. */
static void flat_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    float slope = *(const float *)user;
    (void)worker;
    for (size_t i = 0; i < n; i++, points += 3) {
        float length = (float)shape_length((double)points[0], (double)points[1], (double)points[2]);
        float shell = fabsf(length - 0.9f) - 5e-3f, ball = length - 0.3f;
        float outward = shell < ball && length < 0.9f ? -slope : slope;
        sdf[i] = slope * (shell < ball ? shell : ball);
        for (size_t k = 0; gradient && k < 3; k++) gradient[3 * i + k] = length > 0 ? outward * points[k] / length : 0;
    }
}

/* Between its instances' spheres a scene is a distance, however flat they are. */
TEST(a_flat_field_loses_nothing_in_a_scene)
{
    enum { SMALL_SIDE = 64, SMALL = SMALL_SIDE * SMALL_SIDE };
    static const float slopes[4] = {1.0f, 0.7f, 0.2f, 0.05f};
    dist_context *ctx = test_context();
    const float eye[3] = {2, 1, 3}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
    dist_camera camera = dist_camera_look_at(SMALL_SIDE, SMALL_SIDE, 0.6f, eye, at, up);
    for (int i = 0; i < 16; i++) {
        static float depth[2][SMALL];
        static unsigned char mask[2][SMALL];
        float slope = slopes[i / 4];
        dist_field flat;
        dist_instance one;
        dist_render_desc how;
        memset(&flat, 0, sizeof flat);
        memset(&one, 0, sizeof one);
        memset(&how, 0, sizeof how);
        flat.user = &slope;
        flat.eval_fn = flat_eval;
        flat.radius = 1;
        flat.lipschitz = slope;
        one.field = &flat;
        how.certified = i & 1;
        how.no_cones = i >> 1 & 1;
        dist_scene *scene = dist_scene_create(ctx, 1, &one);
        dist_field fields[2] = {flat, dist_scene_field(scene)};
        for (int k = 0; k < 2; k++) {
            dist_images out;
            memset(&out, 0, sizeof out);
            out.depth = depth[k];
            out.mask = mask[k];
            CHECK_STATUS(DIST_OK, dist_render(ctx, &fields[k], &camera, &how, &out, NULL), ctx);
        }
        CHECK_BYTES(sizeof mask[0], mask[0], mask[1]);
        CHECK_NEAR_ARRAY(SMALL, depth[0], depth[1], 5e-3);
        dist_scene_destroy(scene);
    }
    dist_context_destroy(ctx);
}

TEST(only_create_takes_memory_and_a_failed_one_leaves_none)
{
    test_allocator allocator;
    dist_context_desc desc = test_context_desc();
    memset(&allocator, 0, sizeof allocator);
    desc.allocator = test_allocator_hook(&allocator);
    dist_context *ctx = dist_context_create(&desc);
    float sphere[4] = {0, 0, 0, 0.5f}, points[300], sdf[100], gradient[300], d_code[22];
    dist_field field = dist_field_sphere(sphere);
    dist_instance two[2];
    dist_gradients grads;
    test_random random = test_random_seed(8);
    random_points(&random, 100, 2, points);
    memset(two, 0, sizeof two);
    memset(&grads, 0, sizeof grads);
    memset(d_code, 0, sizeof d_code);
    grads.code = d_code;
    two[0].field = two[1].field = &field;
    two[1].placement.translation[0] = 1;
    size_t live = allocator.live_blocks, requests = allocator.requests;
    dist_scene *scene = dist_scene_create(ctx, 2, two);
    size_t wanted = allocator.requests - requests;
    dist_field all = dist_scene_field(scene);
    requests = allocator.requests;
    dist_scene_set(scene, 1, &two[0]);
    dist_field_eval(ctx, &all, 100, points, sdf, gradient);
    dist_field_backward(ctx, &all, 100, points, sdf, NULL, NULL, NULL, &grads);
    CHECK_EQUAL(requests, allocator.requests);
    CHECK_STATUS(DIST_OK, dist_context_status(ctx), ctx);
    dist_scene_destroy(scene);
    for (size_t n = 1; n <= wanted; n++) {
        dist_context_destroy(ctx);
        allocator.fail_at = 0;
        ctx = dist_context_create(&desc);
        live = allocator.live_blocks;
        allocator.fail_at = allocator.requests + n;
        CHECK(dist_scene_create(ctx, 2, two) == NULL);
        CHECK_STATUS(DIST_OUT_OF_MEMORY, dist_context_status(ctx), ctx);
        CHECK_EQUAL(live, allocator.live_blocks);
    }
    dist_context_destroy(ctx);
    CHECK_EQUAL(0, allocator.live_blocks);
    CHECK_EQUAL(0, allocator.errors);
}

/* How far a ray's line passes a point. */
static double ray_passes(const float *origin, const float *direction, const float *point)
{
    double along = 0.0, square = 0.0, length = 0.0;
    for (int j = 0; j < 3; j++) {
        double v = (double)point[j] - (double)origin[j], d = (double)direction[j];
        along += v * d;
        square += v * v;
        length += d * d;
    }
    return sqrt(fmax(square - along * along / length, 0.0));
}

/* A thousand balls of a 65th of the scene's radius, smaller than its pixels: what a ray may take on trust goes by the
   smallest instance, not by the scene. The truth in double; rays that pass an edge by less than 1e-4 do not count. */
TEST(no_ray_steps_over_an_instance_that_is_small_beside_the_scene)
{
    enum { BALLS = 1000, WIDE = 90, HIGH = 70, RAYS = WIDE * HIGH };
    static dist_instance balls[BALLS];
    static unsigned char mask[RAYS];
    static dist_hit hits[RAYS];
    static float origins[3 * RAYS], directions[3 * RAYS];
    const double ball = 0.1;
    float sphere[4] = {0, 0, 0, 0.1f}, eye[3] = {0, 0, 14};
    dist_context *ctx = shape_context();
    dist_field field = dist_field_sphere(sphere);
    test_random random = test_random_seed(7);
    memset(balls, 0, sizeof balls);
    for (int i = 0; i < BALLS; i++) {
        balls[i].field = &field;
        test_random_fill(&random, 3, balls[i].placement.translation, -4.0f, 4.0f);
    }
    dist_scene *scene = dist_scene_create(ctx, BALLS, balls);
    dist_field all = dist_scene_field(scene);
    dist_camera camera = dist_camera_look_at(WIDE, HIGH, 0.7f, eye, NULL, NULL);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.mask = mask;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &all, &camera, NULL, &out, NULL), ctx);
    for (int i = 0; i < RAYS; i++)
        dist_camera_ray(&camera, (float)(i % WIDE), (float)(i / WIDE), origins + 3 * i, directions + 3 * i);
    CHECK_STATUS(DIST_OK, dist_trace(ctx, &all, RAYS, origins, directions, NULL, hits, NULL), ctx);
    int seen = 0, wrong = 0, wrong_free = 0;
    for (int i = 0; i < RAYS; i++) {
        double edge = 1.0, deepest = -1.0;
        for (int k = 0; k < BALLS; k++) {
            double deep = ball - ray_passes(origins + 3 * i, directions + 3 * i, balls[k].placement.translation);
            edge = fmin(edge, fabs(deep));
            deepest = fmax(deepest, deep);
        }
        if (edge < 1e-4) continue;
        seen += deepest > 0.0;
        wrong += mask[i] != (deepest > 0.0);
        wrong_free += (hits[i].status == DIST_RAY_HIT) != (deepest > 0.0);
    }
    CHECK(seen > 1200);
    CHECK_EQUAL(0, wrong);
    CHECK_EQUAL(0, wrong_free);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

/* Epsilon is float's noise in so large a scene, some hundredths of a small ball: rays that passed one within it ended
   there as on a plateau, before the balls behind. */
TEST(a_ball_that_is_grazed_hides_none_behind_it_in_a_large_scene)
{
    enum { BALLS = 1000, WIDE = 100, HIGH = 80, RAYS = WIDE * HIGH };
    static dist_instance balls[BALLS + 1];
    static unsigned char mask[RAYS];
    const float sphere[4] = {0, 0, 0, 0.5f}, eye[3] = {0.5f, 0.6f, 3}, up[3] = {0, 1, 0};
    dist_context *ctx = shape_context();
    dist_field field = dist_field_sphere(sphere);
    test_random random = test_random_seed(5);
    memset(balls, 0, sizeof balls);
    for (int i = 0; i <= BALLS; i++) {
        balls[i].field = &field;
        balls[i].placement.scale = test_random_float(&random, 0.05f, 0.15f);
        test_random_fill(&random, 3, balls[i].placement.translation, -1.0f, 1.0f);
    }
    balls[BALLS].placement.scale = 1000.0f;
    balls[BALLS].placement.translation[2] = -501.0f;
    dist_scene *scene = dist_scene_create(ctx, BALLS + 1, balls);
    dist_field all = dist_scene_field(scene);
    dist_camera camera = dist_camera_look_at(WIDE, HIGH, 0.9f, eye, NULL, up);
    dist_images out;
    memset(&out, 0, sizeof out);
    out.mask = mask;
    CHECK_STATUS(DIST_OK, dist_render(ctx, &all, &camera, NULL, &out, NULL), ctx);
    int seen = 0, lost = 0;
    for (int i = 0; i < RAYS; i++) {
        float origin[3], direction[3];
        double deepest = 0.0;
        dist_camera_ray(&camera, (float)(i % WIDE), (float)(i / WIDE), origin, direction);
        for (int k = 0; k < BALLS; k++) {
            double radius = 0.5 * (double)balls[k].placement.scale;
            deepest = fmax(deepest, 1.0 - ray_passes(origin, direction, balls[k].placement.translation) / radius);
        }
        seen += deepest > 0.2;
        lost += deepest > 0.2 && !mask[i];
    }
    CHECK(seen > 2000);
    CHECK_EQUAL(0, lost);
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

/* Rays that stepped too far, into a ball, and then came down to another before it: a bracket between the two lost the
   nearer one of one hit in 15,000, for one farther on with a bound of 1e-5. The truth in double. */
TEST(no_ball_is_passed_for_one_behind_it_that_a_step_found)
{
    enum { MOST = 12, RAYS = 20000 };
    static float origins[3 * RAYS], directions[3 * RAYS];
    static dist_hit hits[RAYS];
    dist_context *ctx = test_context();
    int seen = 0, lost = 0, scenes = test_quick() ? 20 : 100;
    for (int k = 0; k < scenes; k++) {
        float ball[MOST][4];
        dist_field field[MOST];
        dist_instance at[MOST];
        test_random random = test_random_seed((unsigned)k + 1);
        int n = 2 + (int)test_random_float(&random, 0.0f, 10.99f);
        memset(at, 0, sizeof at);
        for (int i = 0; i < n; i++) {
            test_random_fill(&random, 3, ball[i], -1.0f, 1.0f);
            ball[i][3] = 0.05f + 0.6f * test_random_float(&random, 0, 1) * test_random_float(&random, 0, 1);
            field[i] = dist_field_sphere(ball[i]);
            at[i].field = &field[i];
        }
        dist_scene *scene = dist_scene_create(ctx, n, at);
        dist_field all = dist_scene_field(scene);
        for (int i = 0; i < RAYS; i++) {
            float away = test_random_float(&random, 2, 5);
            test_random_direction(&random, origins + 3 * i);
            for (int j = 0; j < 3; j++) {
                origins[3 * i + j] *= away;
                directions[3 * i + j] = test_random_float(&random, -1, 1) - origins[3 * i + j];
            }
        }
        CHECK_STATUS(DIST_OK, dist_trace(ctx, &all, RAYS, origins, directions, NULL, hits, NULL), ctx);
        for (int i = 0; i < RAYS; i++) {
            double nearest = 1e9, deep = 0.0, radius = 1.0, length = 0.0, along[MOST], square[MOST];
            int inside = 0;
            for (int j = 0; j < 3; j++) length += (double)directions[3 * i + j] * (double)directions[3 * i + j];
            for (int m = 0; m < n; m++) {
                along[m] = square[m] = 0.0;
                for (int j = 0; j < 3; j++) {
                    double v = (double)ball[m][j] - (double)origins[3 * i + j];
                    along[m] += v * (double)directions[3 * i + j] / sqrt(length);
                    square[m] += v * v;
                }
                double r = (double)ball[m][3], aside = square[m] - along[m] * along[m];
                inside |= square[m] <= r * r;
                if (along[m] < 0.0 || aside >= r * r || along[m] - sqrt(r * r - aside) >= nearest) continue;
                nearest = along[m] - sqrt(r * r - aside);
                radius = r;
                deep = r - sqrt(fmax(aside, 0.0));
            }
            if (inside || nearest > 1e8 || deep < 1e-6) continue;
            seen++;
            lost += hits[i].status != DIST_RAY_HIT ||
                    (double)hits[i].distance > nearest + 1e-3 * radius + 3.0 * sqrt(2.0 * deep * radius);
        }
        dist_scene_destroy(scene);
    }
    CHECK(seen > 3000 * scenes);
    CHECK_EQUAL(0, lost);
    if (test_state.verbose || lost) printf("    %d of %d hits lost\n", lost, seen);
    dist_context_destroy(ctx);
}

/* A ball and a wall so far apart that a step of float's smallest reaches the solid which a larger one had found: rays
   that touch the ball never ended (bounded by max_queries here, as nothing else did). */
/* The third ball, which no ray comes near, makes for a small epsilon and so for a long way through the gap. */
TEST(a_ball_that_is_passed_closely_hides_none_behind_it)
{
    float ball[3][4] = {{0, 0.5f, 0, 0.5f}, {0, 0, 1, 0.45f}, {2, 0, 0, 0.03f}};
    dist_context *ctx = test_context();
    dist_field field[3];
    dist_instance at[3];
    memset(at, 0, sizeof at);
    for (int i = 0; i < 3; i++) {
        field[i] = dist_field_sphere(ball[i]);
        at[i].field = &field[i];
    }
    dist_scene *scene = dist_scene_create(ctx, 3, at);
    dist_field all = dist_scene_field(scene);
    for (int i = 0; i <= 100; i++) {
        double gap = pow(10, -6 + 0.05 * i);
        float o[3] = {0, (float)-gap, -3}, d[3] = {0, 0, 1};
        dist_hit hit;
        for (int more = 0; more < 2; more++) {
            dist_render_desc how;
            memset(&how, 0, sizeof how);
            how.max_steps = more ? 2000 : 0;
            CHECK_STATUS(DIST_OK, dist_trace(ctx, &all, 1, o, d, &how, &hit, NULL), ctx);
            CHECK_EQUAL(DIST_RAY_HIT, hit.status);
            CHECK_NEAR(4 - sqrt(0.45 * 0.45 - gap * gap), hit.distance, (double)hit.error + 1e-5);
        }
    }
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

TEST(certified_rays_that_touch_a_small_ball_in_a_large_scene_end)
{
    const float ball[4] = {0, 0, 0, 0.03f}, wall[4] = {0, 0, -501, 500};
    dist_context *ctx = test_context();
    dist_field near = dist_field_sphere(ball), far = dist_field_sphere(wall);
    dist_instance instances[2];
    memset(instances, 0, sizeof instances);
    instances[0].field = &near;
    instances[1].field = &far;
    instances[0].placement.scale = instances[1].placement.scale = 1.0f;
    dist_scene *scene = dist_scene_create(ctx, 2, instances);
    REQUIRE(scene != NULL);
    dist_field field = dist_scene_field(scene);
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    how.certified = 1;
    how.max_queries = 20000;
    for (int k = -30; k < 40; k++) {
        float origin[3] = {0.03f + 2e-5f * (float)k, 0, 3}, direction[3] = {0, 0, -1};
        dist_hit hit;
        dist_stats stats;
        REQUIRE(dist_trace(ctx, &field, 1, origin, direction, &how, &hit, &stats) == DIST_OK);
        CHECK(hit.status == DIST_RAY_HIT);
        CHECK(fabsf(hit.distance - 3.0f) <= hit.error + 0.04f || fabsf(hit.distance - 4.0f) <= hit.error);
        CHECK(stats.queries < 15000); /* some hundred; with x87 some thousand */
    }
    dist_scene_destroy(scene);
    dist_context_destroy(ctx);
}

int main(int argc, char **argv)
{
    test_begin(argc, argv);
    RUN(a_scene_is_the_least_of_its_placed_fields);
    RUN(no_field_is_asked_outside_its_sphere);
    RUN(the_adjoint_of_a_placement_is_its_derivative_in_double);
    RUN(gradients_for_points_codes_and_placements_are_those_of_double);
    RUN(gradients_for_weights_are_those_of_double_each_nets_once);
    RUN(weights_are_reached_through_pictures_colors_and_scenes_of_scenes);
    RUN(a_scene_looks_like_the_union_that_asks_everything);
    RUN(a_scene_of_one_unmoved_instance_looks_like_its_field);
    RUN(a_small_instance_is_as_sharp_as_alone);
    RUN(a_scene_of_scenes_is_the_flat_scene);
    RUN(twenty_instances_cost_a_query_no_more_than_one_and_a_fifth);
    RUN(a_scene_of_the_dearest_fields_is_not_refused);
    RUN(a_scene_has_the_same_bits_for_any_number_of_threads);
    RUN(a_placement_is_found_from_a_picture_alone_and_with_the_code);
    RUN(a_pixel_pulls_on_the_instance_that_it_shows_alone);
    RUN(moving_a_placement_keeps_it_a_similarity);
    RUN(sizes_below_zero_are_refused_and_a_plate_of_no_thickness_is_not);
    RUN(radii_that_floats_cannot_square_are_refused);
    RUN(scenes_refuse_what_cannot_be_placed);
    RUN(what_is_older_than_what_it_goes_by_is_refused);
    RUN(analytic_fields_whose_numbers_have_changed_are_refused);
    RUN(what_is_not_finite_stays_so);
    RUN(what_is_not_finite_takes_nothing_from_a_placement);
    RUN(colors_are_those_of_the_instance_that_is_hit);
    RUN(colors_outside_of_the_sphere_move_as_its_nearest_point_does);
    RUN(the_figures_of_an_instance_hold_no_farther_out_in_a_large_scene);
    RUN(a_flat_field_loses_nothing_in_a_scene);
    RUN(only_create_takes_memory_and_a_failed_one_leaves_none);
    RUN(no_ray_steps_over_an_instance_that_is_small_beside_the_scene);
    RUN(a_ball_that_is_grazed_hides_none_behind_it_in_a_large_scene);
    RUN(no_ball_is_passed_for_one_behind_it_that_a_step_found);
    RUN(a_ball_that_is_passed_closely_hides_none_behind_it);
    RUN(certified_rays_that_touch_a_small_ball_in_a_large_scene_end);
    return test_report();
}
