/* SPDX-License-Identifier: MIT-0
   fit_pose.c - a known shape and one depth image of it in, the camera out: rotation and translation are moved until the
   rendered depth and silhouette agree with the picture. The paper shows this for one aeroplane with a figure and no
   number; --trials counts how often it succeeds.
   cc -O2 examples/fit_pose.c -lm -o fit_pose && ./fit_pose --target 3 --out out/pose */
#define DIST_IMPLEMENTATION
#include "../dist.h"
#include "common.h"
#include "fit.h"

static const char usage[] =
    "fit_pose [MODEL] [--target WHICH] [--depth FILE.pfm] [options] --out STEM\n"
    "  MODEL              a safetensors file, or the word embedded (default)\n"
    "  --target WHICH     the shape: of the model, by INDEX or a code's FILE (default 0)\n"
    "  --depth FILE.pfm   what is seen; 0, infinity or above 1e5 where nothing is. Without it the shape's own depth\n"
    "                     image from --eye and --at, which are then the truth and not known to the fit\n"
    "  --mask FILE.pfm    its silhouette, not 0 inside (default: where there is depth)\n"
    "  --no-mask          use no silhouette\n" VIEW_USAGE "  --off DEGREES,DISTANCE  how far the start is turned and "
                                                          "moved away from --eye and --at, in a direction chosen by\n"
    "                     chance (default 15,0.15; 0,0 with --depth)\n"
    "  --trials N         N starts, each with a shape (unless --target is given), 10 to 20 degrees and 0.1 to 0.2\n"
    "                     (unless --off is given) chosen by chance; how many recover the pose is counted\n"
    "  --keep PERCENT     of the pixels with depth, keep this many, chosen by chance (default 100)\n"
    "  --points N         or: keep N of them\n"
    "  --seed S           of all that is chosen by chance (default 1)\n"
    "  --iterations N     steps of Adam, the first three quarters in a coarser picture (default 80)\n"
    "  --refine N         steps of Gauss and Newton after them (default 10)\n"
    "  --restarts N       as long as the picture is not explained, try again, 10 degrees beside (default 5)\n"
    "  --rate R           of Adam, at the start (default 0.03)\n"
    "  --weights D,S,0    of depth and silhouette (default 10,100,0)\n"
    "  --gradient WHICH   implicit (default), paper, normal or auto; see the README\n"
    "  --trace WHICH      guarded (default) or paper\n"
    "  --samples K        samples a ray of the paper's gradient, 1 to 8 (default 1)\n"
    "  --threads N        threads to use at most (default all)\n"
    "  --out STEM         files written: STEM.png, STEM_loss.svg, STEM.ply, STEM.json\n";

enum { SNAPSHOTS = 5 };

/* A recovered pose: this near to the true one. */
static const double GOOD_DEGREES = 0.1;
static const double GOOD_DISTANCE = 1e-3;

/* What the user asks for. */
typedef struct request {
    fit_options fit;
    float off[2]; /* degrees, distance; below 0: not given */
    int trials, refine, restarts;
} request;

/* Every step-th pixel of the observation, and the planes of the shape to be compared with it. */
typedef struct level {
    int step;
    size_t n;
    float *seen;
    unsigned char *mask;
    dist_images out, d_out;
    dist_tape *tape;
} level;

/* Everything that one step of the fit needs. */
typedef struct fit {
    const request *asked;
    dist_context *ctx;
    dist_shape *shape;
    dist_field field;
    const observation *seen;
    dist_camera camera; /* the present one, of all pixels */
    dist_camera truth;
    int truth_known;
    level levels[2]; /* coarse, fine */
    rng random;
    dist_stats total;
} fit;

/* What is kept of every step. */
typedef struct record {
    double loss, depth, silhouette, degrees, distance;
    dist_camera camera;
} record;

/* ---- levels ------------------------------------------------------------------------------------------------------ */

static dist_camera level_camera(const dist_camera *camera, int step)
{
    dist_camera c = *camera;
    float k = (float)step;
    c.width = (c.width + step - 1) / step;
    c.height = (c.height + step - 1) / step;
    c.fx /= k;
    c.fy /= k;
    c.skew /= k;
    c.cx = (c.cx - c.pixel_center) / k + c.pixel_center;
    c.cy = (c.cy - c.pixel_center) / k + c.pixel_center;
    return c;
}

static level level_create(const fit *f, int step)
{
    level l;
    memset(&l, 0, sizeof l);
    dist_camera camera = level_camera(&f->camera, step);
    l.step = step;
    l.n = (size_t)camera.width * (size_t)camera.height;
    l.seen = take_floats(l.n);
    l.mask = (unsigned char *)take(l.n, 1);
    for (size_t i = 0; i < l.n; i++) {
        size_t x = i % (size_t)camera.width * (size_t)step;
        size_t y = i / (size_t)camera.width * (size_t)step;
        l.seen[i] = f->seen->seen[y * (size_t)f->seen->width + x];
        l.mask[i] = f->seen->mask[y * (size_t)f->seen->width + x];
    }
    l.out.depth = take_floats(l.n);
    l.d_out.depth = take_floats(l.n);
    l.out.normal = take_floats(3 * l.n);
    l.out.mask = (unsigned char *)take(l.n, 1);
    if (!f->asked->fit.no_mask) {
        l.out.silhouette = take_floats(l.n);
        l.d_out.silhouette = take_floats(l.n);
    }
    l.tape = dist_tape_create(f->ctx, &camera, &f->asked->fit.how);
    check(f->ctx);
    return l;
}

static void level_destroy(level *l)
{
    dist_tape_destroy(l->tape);
    free(l->seen);
    free(l->mask);
    free(l->out.depth);
    free(l->d_out.depth);
    free(l->out.normal);
    free(l->out.mask);
    free(l->out.silhouette);
    free(l->d_out.silhouette);
}

/* ---- the fit ----------------------------------------------------------------------------------------------------- */

/* The angle of the rotation from one camera to the other, degrees. |R - R'| is 2 sqrt(2) sin(angle / 2), which loses
   no digits where the angle is small. */
static double rotation_between(const dist_camera *a, const dist_camera *b)
{
    double square = 0;
    for (int i = 0; i < 9; i++) {
        double d = (double)a->rotation[i] - (double)b->rotation[i];
        square += d * d;
    }
    double s = sqrt(square / 8.0);
    return 2.0 * asin(s < 1.0 ? s : 1.0) * 180.0 / (double)PI;
}

static double translation_between(const dist_camera *a, const dist_camera *b)
{
    double square = 0;
    for (int i = 0; i < 3; i++) {
        double d = (double)a->translation[i] - (double)b->translation[i];
        square += d * d;
    }
    return sqrt(square);
}

/* Renders from the present camera and compares; with a gradient: (6), of the rotation's tangent and the translation. */
static record fit_loss(fit *f, level *l, int normals, float *gradient)
{
    const fit_options *o = &f->asked->fit;
    record r;
    dist_stats stats;
    dist_camera camera = level_camera(&f->camera, l->step);
    dist_images out = l->out;
    if (!normals) { out.normal = NULL; }
    memset(&stats, 0, sizeof stats);
    memset(&r, 0, sizeof r);
    out.stats = l->d_out.stats = &stats;
    memset(l->d_out.depth, 0, l->n * sizeof(float));
    if (l->d_out.silhouette) { memset(l->d_out.silhouette, 0, l->n * sizeof(float)); }
    dist_render(f->ctx, &f->field, &camera, &o->how, &out, l->tape);
    check(f->ctx);
    r.depth = (double)dist_loss_depth(l->n, l->out.depth, l->seen, l->out.mask, o->weights[0], l->d_out.depth);
    if (l->out.silhouette) {
        r.silhouette =
            (double)dist_loss_silhouette(l->n, l->out.silhouette, l->mask, o->weights[1], l->d_out.silhouette);
    }
    r.loss = r.depth + r.silhouette;
    r.camera = f->camera;
    r.degrees = rotation_between(&f->camera, &f->truth);
    r.distance = translation_between(&f->camera, &f->truth);
    if (gradient) {
        dist_gradients grads;
        memset(&grads, 0, sizeof grads);
        memset(gradient, 0, 6 * sizeof(float));
        grads.rotation = gradient;
        grads.translation = gradient + 3;
        dist_render_backward(f->ctx, l->tape, &l->d_out, &grads);
        check(f->ctx);
    }
    add_stats(&f->total, &stats);
    return r;
}

/* a x = b for a positive definite 6 x 6 matrix, by Cholesky's factors; 0 if it is not. */
static int solve6(double a[6][6], const double b[6], double x[6])
{
    for (int i = 0; i < 6; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = a[i][j];
            for (int k = 0; k < j; k++) { sum -= a[i][k] * a[j][k]; }
            if (i == j && !(sum > 0)) { return 0; }
            a[i][j] = i == j ? sqrt(sum) : sum / a[j][j];
        }
    }
    for (int i = 0; i < 6; i++) {
        x[i] = b[i];
        for (int k = 0; k < i; k++) { x[i] -= a[i][k] * x[k]; }
        x[i] /= a[i][i];
    }
    for (int i = 5; i >= 0; i--) {
        for (int k = i + 1; k < 6; k++) { x[i] -= a[k][i] * x[k]; }
        x[i] /= a[i][i];
    }
    return 1;
}

/* The step of Gauss and Newton on the depth, from the planes of the last render with normals. A pixel's residual is
   measured along the normal n: e = n . q (1 - z' / z), q its point in camera space, z' the depth seen there; by the
   implicit rule de = (q - t) x n . w + n . dt. Residuals above their mean count as outliers (Huber). */
static int gauss_newton(fit *f, const level *l, double x[6])
{
    dist_camera camera = level_camera(&f->camera, l->step);
    double a[6][6], b[6], limit = 0;
    memset(a, 0, sizeof a);
    memset(b, 0, sizeof b);
    for (int pass = 0; pass < 2; pass++) {
        double sum = 0;
        double count = 0;
        for (size_t i = 0; i < l->n; i++) {
            double z = (double)l->out.depth[i];
            if (!l->out.mask[i] || !is_depth(l->seen[i])) { continue; }
            double v = ((double)(i / (size_t)camera.width) + (double)camera.pixel_center - (double)camera.cy) /
                       (double)camera.fy;
            double u = ((double)(i % (size_t)camera.width) + (double)camera.pixel_center - (double)camera.cx -
                        (double)camera.skew * v) / (double)camera.fx;
            double n[3] = {(double)l->out.normal[3 * i], (double)l->out.normal[3 * i + 1],
                           (double)l->out.normal[3 * i + 2]};
            double q[3] = {u * z - (double)camera.translation[0], v * z - (double)camera.translation[1],
                           z - (double)camera.translation[2]};
            double e = (n[0] * u + n[1] * v + n[2]) * (z - (double)l->seen[i]);
            if (pass == 0) {
                sum += fabs(e);
                count += 1;
                continue;
            }
            double weight = fabs(e) <= limit ? 1.0 : limit / fabs(e);
            double row[6] = {q[1] * n[2] - q[2] * n[1], q[2] * n[0] - q[0] * n[2], q[0] * n[1] - q[1] * n[0],
                             n[0], n[1], n[2]};
            for (int j = 0; j < 6; j++) {
                b[j] -= weight * row[j] * e;
                for (int k = 0; k <= j; k++) { a[j][k] += weight * row[j] * row[k]; }
            }
        }
        if (pass == 0) { limit = count > 0 ? sum / count : 0; }
    }
    for (int j = 0; j < 6; j++) { a[j][j] *= 1.0 + 1e-6; }
    return solve6(a, b, x);
}

static void move_by(dist_camera *camera, const double x[6], double factor)
{
    float w[3];
    float t[3];
    for (int j = 0; j < 3; j++) {
        w[j] = (float)(factor * x[j]);
        t[j] = (float)(factor * x[3 + j]);
    }
    dist_camera_move(camera, w, t);
}

/* Turns and moves a camera by these amounts in directions chosen by chance. */
static void camera_off(dist_camera *camera, double degrees, double distance, rng *random)
{
    double x[6], length[2] = {0, 0};
    for (int j = 0; j < 6; j++) {
        x[j] = (double)rng_normal(random);
        length[j / 3] += x[j] * x[j];
    }
    for (int j = 0; j < 6; j++) {
        x[j] *= (j < 3 ? degrees * (double)PI / 180.0 : distance) / sqrt(length[j / 3] + 1e-30);
    }
    move_by(camera, x, 1.0);
}

/* Adam on the tangent, in the coarse picture and then in the fine one; the rate falls along a half cosine.
   records: (iterations + refine + 1), one before every step and one of the result; returns how many there are. */
static int fit_once(fit *f, record *records)
{
    const request *asked = f->asked;
    int iterations = asked->fit.iterations;
    float moments[12], move[6], gradient[6];
    dist_adam adam;
    memset(&adam, 0, sizeof adam);
    memset(moments, 0, sizeof moments);
    adam.moments = moments;
    adam.beta2 = 0.99f;
    progress p = progress_begin("fitting");
    for (int i = 0; i < iterations; i++) {
        records[i] = fit_loss(f, &f->levels[4 * i >= 3 * iterations], 0, gradient);
        adam.rate = asked->fit.rate * (0.51f + 0.49f * cosf(PI * (float)i / (float)iterations));
        memset(move, 0, sizeof move);
        dist_adam_step(&adam, 6, move, gradient);
        dist_camera_move(&f->camera, move, move + 3);
        progress_show(&p, i + 1, iterations + asked->refine, "loss", records[i].loss);
    }
    level *fine = &f->levels[1];
    int count = iterations;
    records[count] = fit_loss(f, fine, 1, NULL);
    for (int i = 0; i < asked->refine; i++) {
        double x[6], factor = 1.0;
        record before = records[count];
        record after = before;
        if (!gauss_newton(f, fine, x)) { break; }
        for (; factor > 0.05; factor *= 0.5) { /* a step that is too long is halved */
            move_by(&f->camera, x, factor);
            after = fit_loss(f, fine, 1, NULL);
            if (after.loss < before.loss) { break; }
            f->camera = before.camera;
        }
        if (!(after.loss < before.loss)) { break; }
        records[++count] = after;
        progress_show(&p, iterations + i + 1, iterations + asked->refine, "loss", after.loss);
    }
    progress_end(&p);
    return count + 1;
}

/* Whether the present camera's picture is the one that was seen. */
static int is_explained(const fit *f, score *s)
{
    *s = score_pictures(f->seen, f->levels[1].out.depth, f->levels[1].out.mask);
    return s->depth_error >= 0 && s->depth_error < 1e-4 && s->iou > 0.999;
}

/* Depth and silhouette of some shapes have several minima, as the legs of a table that is turned: a result that does
   not explain the picture is tried again, from beside the best result and from beside the start in turn.
   records: (restarts + 1) times fit_once's. Returns how many there are; the last is of the result. */
static int fit_run(fit *f, record *records)
{
    dist_camera start = f->camera;
    int count = fit_once(f, records);
    record best = records[count - 1];
    score s;
    for (int i = 0; i < f->asked->restarts && !is_explained(f, &s); i++) {
        f->camera = i % 2 ? start : best.camera;
        camera_off(&f->camera, 10.0, 0.05, &f->random);
        count += fit_once(f, records + count);
        if (records[count - 1].loss < best.loss) { best = records[count - 1]; }
    }
    f->camera = best.camera;
    records[count - 1] = fit_loss(f, &f->levels[1], 0, NULL);
    return count;
}

/* ---- starts and trials ------------------------------------------------------------------------------------------- */

static fit fit_create(dist_context *ctx, const dist_net *net, const request *asked, const float *code,
                      const dist_camera *truth, const observation *seen)
{
    fit f;
    memset(&f, 0, sizeof f);
    f.asked = asked;
    f.ctx = ctx;
    f.shape = dist_shape_create(ctx, net, code);
    f.field = dist_shape_field(f.shape);
    f.seen = seen;
    f.camera = f.truth = *truth;
    f.random = rng_begin((unsigned)asked->fit.seed);
    f.truth_known = asked->fit.depth_path == NULL;
    int side = truth->width < truth->height ? truth->width : truth->height;
    f.levels[0] = level_create(&f, side >= 32 ? side / 32 : 1);
    f.levels[1] = level_create(&f, 1);
    check(ctx);
    return f;
}

static void fit_destroy(fit *f)
{
    level_destroy(&f->levels[0]);
    level_destroy(&f->levels[1]);
    dist_shape_destroy(f->shape);
}

static record *take_records(const request *asked)
{
    return (record *)take((size_t)((asked->restarts + 1) * (asked->fit.iterations + asked->refine + 1)),
                          sizeof(record));
}

static int is_good(const record *r)
{
    return r->degrees < GOOD_DEGREES && r->distance < GOOD_DISTANCE;
}

static int compare_doubles(const void *a, const void *b)
{
    const double *x = (const double *)a;
    const double *y = (const double *)b;
    return (*x > *y) - (*x < *y);
}

static void run_trials(dist_context *ctx, const dist_net *net, const request *asked)
{
    const fit_options *o = &asked->fit;
    rng random = rng_begin((unsigned)o->seed);
    int counts[3] = {0, 0, 0}; /* good, ambiguous, lost */
    static const char *const verdicts[3] = {"", "same picture", "lost"};
    size_t codes = (size_t)dist_net_code_count(net);
    if (!o->target && codes == 0 && dist_net_code_size(net) > 0) {
        fail("--trials chooses among the model's codes, and it stores none; give --target FILE");
    }
    double *degrees = (double *)take((size_t)asked->trials, sizeof *degrees);
    double *distance = (double *)take((size_t)asked->trials, sizeof *distance);
    record *records = take_records(asked);
    dist_stats total;
    memset(&total, 0, sizeof total);
    double start = seconds_now();
    printf("trial  shape  degrees off          distance off           mask IoU  depth error\n");
    for (int i = 0; i < asked->trials; i++) {
        int index = codes ? (int)rng_index(&random, codes) : -1;
        float *code = o->target ? choose_code(net, o->target) : NULL;
        dist_camera camera = view_camera(&o->view, 0.0f);
        dist_shape *truth = dist_shape_create(ctx, net, code ? code : dist_net_code(net, index));
        dist_field field = dist_shape_field(truth);
        observation seen = observe_field(ctx, &field, &camera);
        observation_keep(&seen, o->keep, o->points, (unsigned)(o->seed + i));
        fit f = fit_create(ctx, net, asked, code ? code : dist_net_code(net, index), &camera, &seen);
        double off[2] = {10.0 + 10.0 * (double)rng_uniform(&random), 0.1 + 0.1 * (double)rng_uniform(&random)};
        for (int k = 0; k < 2 && asked->off[0] >= 0.0f; k++) { off[k] = (double)asked->off[k]; }
        camera_off(&f.camera, off[0], off[1], &random);
        int count = fit_run(&f, records);
        const record *end = &records[count - 1];
        score s; /* another pose with the same picture, as of a round table, is counted as such */
        int same = is_explained(&f, &s);
        int verdict = is_good(end) ? 0 : same ? 1 : 2;
        counts[verdict]++;
        degrees[i] = end->degrees;
        distance[i] = end->distance;
        printf("%5d  %5d  %7.3f -> %9.5f  %8.4f -> %9.6f  %8.5f  %11.6f  %s\n", i, code ? -1 : index,
               records[0].degrees, end->degrees, records[0].distance, end->distance, s.iou, s.depth_error,
               verdicts[verdict]);
        fflush(stdout);
        add_stats(&total, &f.total);
        fit_destroy(&f);
        observation_destroy(&seen);
        dist_shape_destroy(truth);
        free(code);
    }
    qsort(degrees, (size_t)asked->trials, sizeof *degrees, compare_doubles);
    qsort(distance, (size_t)asked->trials, sizeof *distance, compare_doubles);
    printf("%d of %d recovered: below %g degrees and %g in translation\n", counts[0], asked->trials, GOOD_DEGREES,
           GOOD_DISTANCE);
    printf("%d found another pose with the same picture, %d are lost\n", counts[1], counts[2]);
    printf("median %.6f degrees, %.7f in translation; %llu queries, %.1f seconds\n", degrees[asked->trials / 2],
           distance[asked->trials / 2], total.queries, seconds_now() - start);
    if (o->out) {
        char path[PATH_SIZE];
        json j = json_open(path_of(path, o->out, ".json"));
        json_text(&j, "model", o->model);
        json_count(&j, "trials", (unsigned long long)asked->trials);
        json_count(&j, "recovered", (unsigned long long)counts[0]);
        json_count(&j, "same_picture", (unsigned long long)counts[1]);
        json_count(&j, "lost", (unsigned long long)counts[2]);
        json_number(&j, "rotation_error_deg_median", degrees[asked->trials / 2]);
        json_number(&j, "translation_error_median", distance[asked->trials / 2]);
        json_number(&j, "seconds", seconds_now() - start);
        json_stats(&j, "totals", &total);
        json_close(&j);
        printf("%s\n", path);
    }
    free(records);
    free(degrees);
    free(distance);
}

/* ---- report of one fit ------------------------------------------------------------------------------------------- */

/* Above, the shape from the camera on its way; below, where its depth and outline differ from what was seen. */
static void write_strip(fit *f, const record *records, int count)
{
    const observation *s = f->seen;
    int last = count - 1;
    int steps[SNAPSHOTS] = {0, last / 20, last / 8, last * 3 / 10, last};
    int zoom = picture_zoom(s->width, s->height);
    canvas pictures[2 * (SNAPSHOTS + 1)];
    char text[2 * (SNAPSHOTS + 1)][32];
    const char *captions[2 * (SNAPSHOTS + 1)];
    int columns = SNAPSHOTS + 1;
    pictures[0] = picture_seen(s, !f->asked->fit.no_mask);
    canvas_enlarge(&pictures[0], zoom);
    snprintf(text[0], sizeof text[0], "seen: %.0f pixels", (double)s->seen_count);
    pictures[columns] = picture_field(f->ctx, &f->field, &f->truth);
    snprintf(text[columns], sizeof text[0], f->truth_known ? "truth" : "--eye and --at");
    for (int i = 0; i < SNAPSHOTS; i++) {
        const record *r = &records[steps[i]];
        f->camera = r->camera;
        fit_loss(f, &f->levels[1], 0, NULL);
        pictures[1 + i] = picture_field(f->ctx, &f->field, &r->camera);
        pictures[columns + 1 + i] =
            picture_error(s->width, s->height, f->levels[1].out.depth, f->levels[1].out.mask, s->depth, s->mask, 0.1f);
        canvas_enlarge(&pictures[columns + 1 + i], zoom);
        snprintf(text[1 + i], sizeof text[0], i == 0 ? "start" : i + 1 == SNAPSHOTS ? "result, step %d" : "step %d",
                 steps[i]);
        snprintf(text[columns + 1 + i], sizeof text[0], "%.2f degrees, %.3f off", r->degrees, r->distance);
    }
    for (int i = 0; i < 2 * columns; i++) { captions[i] = text[i]; }
    canvas strip = picture_sheet(2 * columns, pictures, captions, columns);
    printf("%s\n", write_canvas(f->asked->fit.out, &strip));
    for (int i = 0; i < 2 * columns; i++) { canvas_destroy(&pictures[i]); }
}

static void write_loss(const fit *f, const record *records, int count)
{
    static const char *const names[] = {"loss", "depth", "silhouette", "degrees off", "translation off"};
    size_t n = (size_t)count;
    double *columns = (double *)take(5 * n, sizeof *columns);
    curve curves[5];
    size_t used = 0;
    for (size_t k = 0; k < 5; k++) {
        double largest = 0;
        if (k >= 3 && !f->truth_known) { continue; }
        for (size_t i = 0; i < n; i++) {
            const record *r = &records[i];
            double values[5] = {r->loss, r->depth, r->silhouette, r->degrees, r->distance};
            columns[k * n + i] = values[k];
            largest = values[k] > largest ? values[k] : largest;
        }
        if (!(largest > 0)) { continue; }
        curves[used].name = names[k];
        curves[used].n = n;
        curves[used].x = NULL;
        curves[used++].y = columns + k * n;
    }
    char path[PATH_SIZE];
    path_of(path, f->asked->fit.out, "_loss.svg");
    write_curves(path, "the camera's way", "step", "weighted loss; error", used, curves, 1);
    printf("%s\n", path);
    free(columns);
}

/* Points (n, 3) of the world in the camera's space. */
static void place_before(const dist_camera *camera, size_t n, const float *points, float *placed)
{
    for (size_t i = 0; i < 3 * n; i += 3) {
        float x[3] = {points[i], points[i + 1], points[i + 2]};
        for (size_t k = 0; k < 3; k++) {
            const float *row = camera->rotation + 3 * k;
            placed[i + k] = row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + camera->translation[k];
        }
    }
}

/* Chamfer distance of the shape before the camera of the start, and that of the end, from the shape before the true
   one; not known without. */
static void score_places(const fit *f, const dist_camera *start, const dist_camera *end, score scores[2])
{
    float *points = NULL;
    dist_mesh_destroy(surface_of(f->ctx, &f->field, &points));
    float *truth = points && f->truth_known ? take_floats(3 * SURFACE_POINTS) : NULL;
    float *placed = take_floats(3 * SURFACE_POINTS);
    for (int i = 0; i < 2 && truth; i++) {
        place_before(&f->truth, SURFACE_POINTS, points, truth);
        place_before(i ? end : start, SURFACE_POINTS, points, placed);
        scores[i].chamfer = chamfer_between(f->ctx, truth, placed);
    }
    free(placed);
    free(truth);
    free(points);
}

/* The shape in the recovered camera's space, to be laid over points made from the depth image. */
static void write_mesh(fit *f)
{
    char path[PATH_SIZE];
    float *points = NULL;
    dist_mesh *mesh = surface_of(f->ctx, &f->field, &points);
    place_before(&f->camera, mesh->vertex_count, mesh->vertices, mesh->vertices);
    dist_mesh_save(f->ctx, mesh, path_of(path, f->asked->fit.out, ".ply"));
    check(f->ctx);
    printf("%s\n", path);
    dist_mesh_destroy(mesh);
    free(points);
}

static void write_report(const fit *f, const record *start, const record *end, const score scores[2], int steps,
                         double seconds)
{
    static const char *const when[] = {"start", "end"};
    const fit_options *o = &f->asked->fit;
    char path[PATH_SIZE];
    json j = json_open(path_of(path, o->out, ".json"));
    json_text(&j, "model", o->model);
    json_text(&j, "target", o->target ? o->target : "0");
    for (int i = 0; i < 2; i++) {
        json_score(&j, "loss", when[i], (i ? end : start)->loss);
        json_score(&j, "depth_error", when[i], scores[i].depth_error);
        json_score(&j, "iou", when[i], scores[i].iou);
        json_score(&j, "chamfer", when[i], scores[i].chamfer);
    }
    if (f->truth_known) {
        json_number(&j, "rotation_error_deg_start", start->degrees);
        json_number(&j, "translation_error_start", start->distance);
        json_number(&j, "rotation_error_deg", end->degrees);
        json_number(&j, "translation_error", end->distance);
    } else {
        json_null(&j, "rotation_error_deg");
        json_null(&j, "translation_error");
    }
    json_count(&j, "queries", f->total.queries);
    json_number(&j, "seconds", seconds);
    json_count(&j, "iterations", (unsigned long long)steps);
    json_count(&j, "pixels", f->seen->n);
    json_count(&j, "pixels_hit", f->seen->hits);
    json_count(&j, "pixels_seen", f->seen->seen_count);
    json_floats(&j, "weights", 2, o->weights);
    json_number(&j, "rate", (double)o->rate);
    dist_render_desc how = dist_render_desc_resolve(&o->how);
    json_text(&j, "gradient", gradient_name(how.gradient));
    json_text(&j, "trace", how.trace == DIST_TRACE_PAPER ? "paper" : "guarded");
    json_count(&j, "seed", (unsigned long long)o->seed);
    json_camera(&j, "camera", &f->camera);
    if (f->truth_known) { json_camera(&j, "truth", &f->truth); }
    json_stats(&j, "totals", &f->total);
    json_close(&j);
    printf("%s\n", path);
}

static void print_row(const char *name, double start, double end)
{
    printf("  %-18s", name);
    for (int i = 0; i < 2; i++) {
        double value = i ? end : start;
        if (value < 0) {
            printf("%12s%s", "none", i ? "\n" : "  -> ");
        } else {
            printf("%12.6f%s", value, i ? "\n" : "  -> ");
        }
    }
}

/* What is seen: a file, or the known shape from the true camera. */
static observation observe(dist_context *ctx, const dist_net *net, request *r, const float *code, dist_camera *camera)
{
    fit_options *o = &r->fit;
    observation seen;
    if (o->depth_path) {
        seen = observe_file(ctx, o);
        *camera = view_camera(&o->view, 0.0f);
    } else {
        *camera = view_camera(&o->view, 0.0f);
        dist_shape *shape = dist_shape_create(ctx, net, code);
        dist_field field = dist_shape_field(shape);
        seen = observe_field(ctx, &field, camera);
        dist_shape_destroy(shape);
    }
    observe_mask(ctx, o->mask_path, &seen);
    observation_keep(&seen, o->keep, o->points, (unsigned)o->seed);
    return seen;
}

static void run_one(dist_context *ctx, const dist_net *net, request *r)
{
    dist_camera camera;
    float *code = choose_code(net, r->fit.target);
    observation seen = observe(ctx, net, r, code, &camera);
    fit f = fit_create(ctx, net, r, code, &camera, &seen);
    record *records = take_records(r);
    score scores[2];
    if (r->off[0] < 0.0f) {
        r->off[0] = r->fit.depth_path ? 0.0f : 15.0f;
        r->off[1] = r->fit.depth_path ? 0.0f : 0.15f;
    }
    camera_off(&f.camera, (double)r->off[0], (double)r->off[1], &f.random);
    record start = fit_loss(&f, &f.levels[1], 0, NULL);
    is_explained(&f, &scores[0]);
    double begin = seconds_now();
    int count = fit_run(&f, records);
    double seconds = seconds_now() - begin;
    record end = records[count - 1];
    is_explained(&f, &scores[1]);
    f.camera = end.camera;
    score_places(&f, &start.camera, &end.camera, scores);
    write_report(&f, &start, &end, scores, count - 1, seconds);
    write_mesh(&f);
    write_loss(&f, records, count);
    write_strip(&f, records, count);
    f.camera = end.camera;
    printf("%d steps, %llu queries, %.2f seconds\n", count - 1, f.total.queries, seconds);
    print_row("loss", start.loss, end.loss);
    print_row("depth error", scores[0].depth_error, scores[1].depth_error);
    print_row("mask IoU", scores[0].iou, scores[1].iou);
    if (f.truth_known) {
        print_row("Chamfer", scores[0].chamfer, scores[1].chamfer);
        print_row("rotation, degrees", start.degrees, end.degrees);
        print_row("translation", start.distance, end.distance);
    }
    tell_if_not_fallen(start.loss, end.loss, (double)r->fit.rate);
    if (scores[1].iou == 0) { printf("nothing of the shape lies where it was seen: try another --off, --eye or --at\n"); }
    free(records);
    free(code);
    fit_destroy(&f);
    observation_destroy(&seen);
}

/* ---- options ----------------------------------------------------------------------------------------------------- */

static request request_defaults(void)
{
    request r;
    memset(&r, 0, sizeof r);
    r.fit = fit_defaults();
    r.fit.how.gradient = DIST_GRADIENT_IMPLICIT;
    r.fit.how.samples = 1;
    r.fit.iterations = 80;
    r.fit.rate = 0.03f;
    r.fit.weights[1] = 100.0f; /* of dist_loss_silhouette's mean over all pixels */
    r.fit.weights[2] = 0.0f;
    r.off[0] = r.off[1] = -1.0f;
    r.refine = 10;
    r.restarts = 5;
    return r;
}

static request read_options(int argc, char **argv)
{
    request r = request_defaults();
    fit_options *o = &r.fit;
    options walk = options_begin(argc, argv, usage);
    while (option_next(&walk)) {
        if (option_is(&walk, "--off")) {
            option_floats(&walk, 2, r.off);
            if (r.off[0] < 0.0f || r.off[0] > 180.0f || r.off[1] < 0.0f || r.off[1] > 1000.0f) {
                fail("--off must be 0 to 180 degrees and a distance of 0 to 1000");
            }
        } else if (option_is(&walk, "--trials")) {
            r.trials = option_int(&walk, 1, 100000);
        } else if (option_is(&walk, "--refine")) {
            r.refine = option_int(&walk, 0, 1000);
        } else if (option_is(&walk, "--restarts")) {
            r.restarts = option_int(&walk, 0, 1000);
        } else if (option_is(&walk, "--start")) {
            fail("--start is a code to begin with, and here the shape is known; --off says where the camera begins");
        } else if (!option_fit(&walk, o)) {
            option_unknown(&walk);
        }
    }
    fit_options checked = *o;
    if (o->depth_path) { checked.target = NULL; } /* here the one is the shape, the other the picture of it */
    check_fit_options(&checked);
    if (o->weights[2] > 0.0f) { fail("--weights D,S,0: there is no code to weigh here"); }
    if (r.trials && (o->depth_path || o->mask_path)) {
        fail("--trials renders its own observations; leave out --depth and --mask");
    }
    if (!o->out && !r.trials) { fail("--out STEM is needed: where the results go"); }
    if (!o->model) { o->model = "embedded"; }
    if (!o->view.width && !o->depth_path) { o->view.width = o->view.height = 64; }
    if (o->out) { check_stem(o->out); }
    return r;
}

int main(int argc, char **argv)
{
    request r = read_options(argc, argv);
    dist_context *ctx = dist_context_create(&r.fit.settings);
    dist_net *net = load_model(ctx, r.fit.model);
    if (r.trials) {
        run_trials(ctx, net, &r);
    } else {
        run_one(ctx, net, &r);
    }
    dist_net_destroy(net);
    dist_context_destroy(ctx);
    return 0;
}
